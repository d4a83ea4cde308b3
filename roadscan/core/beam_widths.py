"""Widths of lidar beams by model, as their makers state them."""

from __future__ import annotations

import re
from typing import Final

DIVERGENCE_DEG: Final = {
    "hdl64": 0.115, "hdl32": 0.17, "vlp16": 0.18, "vlp32": 0.18, "os0": 0.35, "os1128": 0.18, "os1": 0.13,
    "xt32": 0.095,
}  # fmt: skip
"""Full angle of the beam, the wider one where two are stated (degrees), by letters and digits of the model. Velodyne:
HDL-64E S2 manual 2.0 mrad, HDL-32E manual 2.97 mrad, VLP-16 manual 63-9243 and VLP-32C 3.0 mrad; Ouster: OS0 data sheet
0.35°, OS1 data sheet 0.18° with 128 beams and 0.13° with 64 and 16 (full width at half maximum); Hesai: PandarXT-32
data sheet 0.095°. OS1's were read again in the data sheet when this was written, the others were not: a rig file that
states `divergence_deg` goes before them."""


def divergence_of(model: str) -> float | None:
    """Return the full angle of a model's beam (degrees); None where it is not known.

    model : maker's name for it in any spelling, such as "Velodyne HDL-32E".
    """
    plain = re.sub(r"[^a-z0-9]", "", model.lower())
    return next((width for name, width in DIVERGENCE_DEG.items() if name in plain), None)
