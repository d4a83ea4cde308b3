"""Points of one tile: the view of the raw readings that products and cells are made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.model.ids import TileId

QUANTUM_M: Final = 1e-5
"""Point coordinates are whole numbers of this (10 µm): sums are exact, so results do not depend on order."""
QUANTA_PER_M: Final = 100_000


@dataclass(frozen=True)
class TilePoints:
    """Points of one tile in canonical order (epoch, sensor, reading), so equal inputs give equal bytes.

    All arrays are (n,). One quantum is 10 µm (:data:`QUANTUM_M`).
    """

    tile: TileId
    x_quanta: npt.NDArray[np.int32]
    """East of the tile's south-west corner, quanta."""
    y_quanta: npt.NDArray[np.int32]
    """North of the tile's south-west corner, quanta."""
    height_quanta: npt.NDArray[np.int32]
    """Height in the map frame, quanta above its zero."""
    epoch_gps_ns: npt.NDArray[np.int64]
    """GPS time of the reading."""
    intensity: npt.NDArray[np.uint16]
    """Intensity as recorded (scaled to 16 bits by the format)."""
    classification: npt.NDArray[np.uint8]
    """ASPRS class: 1 unclassified unless the raw data say otherwise."""
    pass_id: npt.NDArray[np.uint16]
    """Pass of the reading."""
    extra: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    """Further recorded values by column name of the table ``cloud`` (return_number, number_of_returns,
    scan_angle_deg, flags, user_data,
    point_source_id, red, green, blue): for every point, where any reading has them."""

    def __len__(self) -> int:
        return int(self.x_quanta.size)
