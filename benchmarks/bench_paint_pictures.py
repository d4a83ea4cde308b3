"""Lines and markings of drawn streets, from products of ``roadscan run`` by default, with pictures and without.

Streets 1 and 3 were looked at; 21 and 22 are only scored.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.labelled_street import run
from benchmarks.lawn_streets import with_and_without_pictures
from benchmarks.paint_streets import drawn, score
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure

STREETS: Final = (
    (1, "VLP-16"), (3, "VLP-16"), (21, "VLP-16"), (22, "VLP-16"), (21, "HDL-32E"), (22, "HDL-32E"),
)  # fmt: skip
"""Seed and lidar."""
LOOKED_AT: Final = {1, 3}


def figures(folder: Path) -> Iterator[Figure]:
    """Each street, by returns alone and with pictures."""
    for seed, model in STREETS:
        seen = "looked at" if seed in LOOKED_AT else "only scored"
        street = bench_folder(folder) / f"paint {seed} {model}"
        for name, file in with_and_without_pictures(drawn(seed, model, street), folder):
            run(file)
            found, what = score(street, file), f"street {seed}, {model} ({seen}), {name}"
            yield Figure(f"{what}: painted length of lines found", found.found, "", found.line_m, "m of paint")
            yield Figure(f"{what}: painted length whose pattern is right", found.pattern, "")
            yield Figure(f"{what}: of the lines found, right", found.right, "")
            yield Figure(f"{what}: number of pieces of lines", found.pieces, "")
            yield Figure(f"{what}: F1 of cells of 0.1 m, all paint", found.marking_f1, "")
            yield Figure(f"{what}: F1 of cells of 0.1 m, what is no line", found.other_f1, "")
            for quantity, error, sigma in (
                ("place of lines", found.aside_m, found.aside_sigma_m),
                ("width of lines", found.width_error_m, found.width_sigma_m),
            ):
                if error.size:
                    rms, stated = (1000.0 * float(np.sqrt(np.mean(np.square(v)))) for v in (error, sigma))
                    yield Figure(f"{what}: {quantity}, error (RMS)", rms, "mm", stated, "stated")
