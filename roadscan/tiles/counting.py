"""Counts raw readings into the cells of active tiles, without writing points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int32, Int64
from roadscan.core.scan_geometry import ScanGeometry
from roadscan.georeference.charts import flat_profiles
from roadscan.georeference.kernels.flat_profiles import FlatProfiles
from roadscan.georeference.kernels.readings import Georeference, MirrorProfiles, Returns
from roadscan.georeference.kernels.timed_readings import CHUNK
from roadscan.georeference.place import COUNTED_FATES, EIGHT_TO_SIXTEEN_BITS, Placement, mirror_profiles
from roadscan.tiles.accumulator import Accumulator
from roadscan.tiles.kernels.accumulate import CountingWork
from roadscan.tiles.kernels.bucket_statistics import bucket_mirror, bucket_returns
from roadscan.tiles.kernels.pool import Pool
from roadscan.tiles.kernels.profile_counting import accumulate_profiles
from roadscan.tiles.kernels.row_buckets import ActiveTiles, Buckets, Measured

_EIGHT_BITS: Final = np.uint32(EIGHT_TO_SIXTEEN_BITS)
_SIXTEEN_BITS: Final = np.uint32(1)  # Factor on intensities that have 16 bits already.


@dataclass(frozen=True)
class Counting:
    """Counts the readings of one source into an accumulator."""

    placement: Placement
    accumulator: Accumulator
    geometry: ScanGeometry | None
    """None for returns."""
    fates: Int64 = field(default_factory=lambda: np.zeros(COUNTED_FATES, np.int64))
    """Readings by outcome (``FATE_NAMES``); readings in inactive tiles count as outside."""

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
            georeference = self.placement.georeference(mounting)
            epochs, raw, shine = epochs_gps_ns[rows], ranges[rows], bright[rows]
            if flat is None:
                m = geometry.readings
                own = passes[rows.start * m : rows.stop * m]
                measured = self._measured(geometry.all_epochs(epochs), own, shine.reshape(-1), _EIGHT_BITS)
                self._mirror(mirror_profiles(geometry, epochs, raw), measured, georeference)
            else:
                self._flat(raw, self._measured(epochs, passes[rows], shine, _EIGHT_BITS), flat, georeference)

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
            returns = Returns(pose_epochs_gps_ns[rows], *(axis[rows] for axis in xyz_sensor_m))
            measured = self._measured(epochs_gps_ns[rows], passes[rows], intensity[rows], _SIXTEEN_BITS)
            self._returns(returns, measured, self.placement.georeference(mounting))

    def _measured(self, epochs: Int64, passes: Int32, intensity: npt.NDArray[Any], gain: np.uint32) -> Measured:
        return Measured(epochs, passes, intensity, gain, self.placement.interval_sigmas_m)

    def _flat(
        self, ranges: npt.NDArray[np.uint16], measured: Measured, flat: FlatProfiles, georeference: Georeference
    ) -> None:
        def count(active: ActiveTiles, pool: Pool, work: CountingWork, first: int) -> int:
            done: int = accumulate_profiles(
                ranges, measured, flat, georeference, active, pool, work, self.fates, first
            )  # fmt: skip
            return done

        self.accumulator.run(count, len(ranges), 2 * ranges.shape[1])

    def _returns(self, returns: Returns, measured: Measured, georeference: Georeference) -> None:
        def fill(active: ActiveTiles, buckets: Buckets, first: int) -> int:
            done: int = bucket_returns(returns, measured, georeference, active, buckets, self.fates, first)
            return done

        self.accumulator.fill(fill, returns.epochs.size, CHUNK)

    def _mirror(self, profiles: MirrorProfiles, measured: Measured, georeference: Georeference) -> None:
        def fill(active: ActiveTiles, buckets: Buckets, first: int) -> int:
            done: int = bucket_mirror(profiles, measured, georeference, active, buckets, self.fates, first)
            return done

        self.accumulator.fill(fill, profiles.epochs.size, max(CHUNK, profiles.ranges.shape[1]))
