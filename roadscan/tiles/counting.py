"""Raw readings → cells of active tiles, without points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.kernels.flat_profiles import accumulate_profiles
from roadscan.kernels.piled_readings import pile_mirror, pile_returns
from roadscan.kernels.placing import CHUNK
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
            arrays: tuple[npt.NDArray[Any], ...] = (
                epochs_gps_ns[rows],
                pose_epochs_gps_ns[rows],
                *(axis[rows] for axis in xyz_sensor_m),
            )
            self._returns(self.placement.poses(mounting), arrays, intensity[rows], passes[rows])

    @property
    def _cells(self) -> tuple[tuple[int, int], int, int]:
        grid = self.accumulator.grid
        return self.accumulator.corner_quanta, grid.cell_quanta, grid.cells_per_edge

    @property
    def _place(self) -> tuple[Any, ...]:
        """Limits and cells, active tiles and what is noted of them."""
        held = self.accumulator
        return (
            self.placement.limits, float(QUANTA_PER_M), held.corner_quanta, held.grid.cell_quanta, held.tile_rows,
            held.spans, held.sigmas, self.placement.interval_sigmas_m,
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

    def _returns(self, poses: Any, arrays: tuple[npt.NDArray[Any], ...], intensity: Any, passes: Int32) -> None:
        def pile(ends: Any, piles: Any, first: int) -> int:
            done: int = pile_returns(
                *arrays, intensity, _SIXTEEN_BITS, passes, poses, *self._place, ends, piles, self.fates, first
            )
            return done

        self.accumulator.pile(pile, passes.size, CHUNK)

    def _mirror(self, geometry: ScanGeometry, poses: Any, epochs: Int64, raw: Any, bright: Any, passes: Int32) -> None:
        m = geometry.readings
        own_epochs = geometry.all_epochs(epochs)
        scale = geometry.range_offset_m, geometry.range_step_m

        def pile(ends: Any, piles: Any, first: int) -> int:
            done: int = pile_mirror(
                epochs, own_epochs, raw, *geometry.rays(), scale, geometry.reading_period_ns, bright.reshape(-1),
                _EIGHT_BITS, passes, poses, *self._place, ends, piles, self.fates, first,
            )  # fmt: skip
            return done

        self.accumulator.pile(pile, epochs.size, max(CHUNK, m))
