"""Raw readings → cells of active tiles, without points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.kernels.accumulate import PIECE, accumulate_cells
from roadscan.kernels.by_cell import into_order
from roadscan.kernels.flat_profiles import accumulate_profiles
from roadscan.kernels.placed_cells import find_mirror, find_returns
from roadscan.points.cloud import QUANTA_PER_M
from roadscan.points.flat_profiles import FlatProfiles, flat_profiles
from roadscan.points.place import COUNTED_FATES, EIGHT_TO_SIXTEEN_BITS, Placement
from roadscan.points.readings import ScanGeometry
from roadscan.tiles.accumulator import Accumulator

_EIGHT_BITS: Final = np.uint32(EIGHT_TO_SIXTEEN_BITS)
_SIXTEEN_BITS: Final = np.uint32(1)

Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Counting:
    """Readings of one source on their way into an accumulator."""

    placement: Placement
    accumulator: Accumulator
    geometry: ScanGeometry | None
    """None for returns."""
    fates: Int64 = field(default_factory=lambda: np.zeros(COUNTED_FATES, np.int64))
    """Readings by fate (``FATE_NAMES``); those of tiles that are not active count as outside."""

    def profiles(
        self,
        epochs_gps_ns: Int64,
        ranges: npt.NDArray[np.uint16],
        intensity: npt.NDArray[np.uint8] | None,
        passes: Int32,
    ) -> None:
        """Count n profiles.

        Parameters
        ----------
        epochs_gps_ns : (n,) of the first readings; ranges, intensity : (n, m), raw; no intensity counts as 0.
        passes : (n,), or (n · m,) where a mirror measures one reading after another: index into the accumulator's
        passes, −1 for none.
        """
        geometry = self.geometry
        if geometry is None:
            raise ValueError("profiles need a scan geometry")
        bright = np.zeros(ranges.shape, np.uint8) if intensity is None else intensity
        flat = flat_profiles(geometry, self.placement.range_min_m, self.placement.range_max_m)
        if self.placement.road is not None:
            road = self.placement.road.profiles(epochs_gps_ns, ranges, geometry)
            road.tell(self.fates)
            ranges = road.ranges
        for rows, mounting in self.placement.mountings.pieces(epochs_gps_ns):
            poses = self.placement.poses(mounting)
            epochs, raw, shine = epochs_gps_ns[rows], ranges[rows], bright[rows]
            if flat is None:
                m = geometry.readings
                self._mirror(geometry, poses, epochs, raw, shine, passes[rows.start * m : rows.stop * m])
            else:
                self._flat(flat, poses, epochs, raw, shine, passes[rows])

    def returns(
        self,
        epochs_gps_ns: Int64,
        pose_epochs_gps_ns: Int64,
        xyz_sensor_m: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.float32]],
        intensity: npt.NDArray[np.uint16],
        passes: Int32,
    ) -> None:
        """Count n returns; all arrays are (n,), `passes` as in :meth:`profiles`."""
        for rows, mounting in self.placement.mountings.pieces(pose_epochs_gps_ns):
            poses, order = self.placement.poses(mounting), self.accumulator.order(rows.stop - rows.start)
            found = find_returns(
                epochs_gps_ns[rows], pose_epochs_gps_ns[rows], *(axis[rows] for axis in xyz_sensor_m), passes[rows],
                poses, *self._place, *order[:4], self.fates,
            )  # fmt: skip
            self._count(found, order, passes[rows], intensity[rows], _SIXTEEN_BITS)

    @property
    def _cells(self) -> tuple[tuple[int, int], int, int]:
        grid = self.accumulator.grid
        return self.accumulator.corner_quanta, grid.cell_quanta, grid.cells_per_edge

    @property
    def _place(self) -> tuple[Any, ...]:
        """Limits and cells, active tiles and what is noted of them."""
        held = self.accumulator
        return (
            self.placement.limits, float(QUANTA_PER_M), *self._cells,
            held.tile_rows, held.spans, held.sigmas, self.placement.interval_sigmas_m,
        )  # fmt: skip

    def _flat(self, flat: FlatProfiles, poses: Any, epochs: Int64, raw: Any, bright: Any, passes: Int32) -> None:
        def count(tile_rows: Any, groups: Any, pool: Any, work: Any, spans: Any, sigmas: Any, first: int) -> int:
            done: int = accumulate_profiles(
                epochs, raw, bright, _EIGHT_BITS, passes, flat.rays, flat.middle, flat.scale, poses, flat.raw_limits,
                self.placement.limits, float(QUANTA_PER_M), *self._cells, tile_rows, groups, pool, work,
                spans, sigmas, self.placement.interval_sigmas_m, self.fates, first,
            )  # fmt: skip
            return done

        self.accumulator.run(count, epochs.size, 2 * raw.shape[1])

    def _mirror(self, geometry: ScanGeometry, poses: Any, epochs: Int64, raw: Any, bright: Any, passes: Int32) -> None:
        m = geometry.readings
        readings = np.arange(epochs.size * m)
        own_epochs = geometry.reading_epochs(epochs[readings // m], readings % m)
        order = self.accumulator.order(own_epochs.size)
        found = find_mirror(
            epochs, own_epochs, raw, passes, *geometry.rays(), (geometry.range_offset_m, geometry.range_step_m),
            geometry.reading_period_ns, poses, *self._place, *order[:4], self.fates,
        )  # fmt: skip
        self._count(found, order, passes, bright.reshape(-1), _EIGHT_BITS)

    def _count(self, found: int, order: Any, passes: Int32, intensity: Any, gain: np.uint32) -> None:
        """Count readings that were found, in the order of their cells."""
        into_order(found, order, passes, intensity, gain)
        column, row, heights, of_pass, bright = order[7:]

        def count(tile_rows: Any, groups: Any, pool: Any, work: Any, _spans: Any, _sigmas: Any, first: int) -> int:
            done: int = accumulate_cells(
                column[:found], row[:found], heights, of_pass, bright,
                self.accumulator.grid.cells_per_edge, tile_rows, groups, pool, work, self.fates, first,
            )  # fmt: skip
            return done

        self.accumulator.run(count, found, 2 * PIECE)
