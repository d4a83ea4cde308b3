"""The points of one tile, and their canonical order: equal readings give equal files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from roadscan.core.grid import TileId


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

    def and_then(self, other: TilePoints) -> TilePoints:
        """Return these points followed by `other` of the same tile; missing values become those of a single return."""
        size, more = len(self), len(other)
        extra: dict[str, npt.NDArray[Any]] = {}
        for name in (*self.extra, *(n for n in other.extra if n not in self.extra)):
            kind = (self.extra if name in self.extra else other.extra)[name].dtype
            parts = (self.extra.get(name, fill_of(name, size, kind)), other.extra.get(name, fill_of(name, more, kind)))
            extra[name] = np.concatenate(parts)
        arrays = {
            f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)])
            for f in fields(self)
            if f.name not in {"tile", "extra"}
        }
        return TilePoints(tile=self.tile, extra=extra, **arrays)


def fill_of(column: str, size: int, kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return values (n,) of an extra column for points without recorded ones."""
    return np.full(size, 1 if column in {"return_number", "number_of_returns"} else 0, kind)


def canonical_order(
    source: npt.NDArray[np.integer[Any]],
    epoch_gps_ns: npt.NDArray[np.int64],
    whole_profiles: npt.NDArray[np.bool_],
    content: Callable[[], list[npt.NDArray[Any]]],
) -> npt.NDArray[np.int64] | None:
    """Return the order by source, epoch and, where epochs repeat, content; None where the points are in order.

    Parameters
    ----------
    source : (n,) number of the sensor and run, ascending as loaded.
    epoch_gps_ns : (n,).
    whole_profiles : (n,) True where equal epochs mean readings of one profile, already in their order.
    content : gives arrays (n, …) that distinguish points of equal epoch, called only where there are any;
        points equal in all of them are interchangeable.
    """
    same = source[1:] == source[:-1]
    step = np.diff(epoch_gps_ns)
    falls = same & (step < 0)
    tied = same & (step == 0) & ~whole_profiles[1:]
    if not falls.any() and not tied.any():
        return None
    keys = [k for tie in reversed(content()) for k in (tie.T[::-1] if tie.ndim == 2 else [tie])]
    order: npt.NDArray[np.int64] = np.lexsort([*keys, epoch_gps_ns, source])
    return order
