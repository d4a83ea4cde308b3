"""A sensor's clock: converts true epochs to stamps, and gives the clock's entry in the survey file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from roadscan.compute.array_types import Int64
from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import (
    GPS_EPOCH_UNIX_S,
    NS_PER_S,
    WEEK_S,
    TimeSystem,
    gps_ns_from_utc,
    leap_seconds_at_gps,
    utc_from_gps_ns,
)
from roadscan.simulate.scene import ClockError, Scene

_NOTHING_S: Final = 1e-9
"""Offset that stands for none where the survey file has to state one (s)."""


@dataclass(frozen=True)
class SensorClock:
    """Stamps of one sensor's log."""

    error: ClockError
    system: TimeSystem
    """Time system of the stamps."""
    start_gps_ns: int
    """Epoch from which the drift counts: the first profile of the first pass."""

    @classmethod
    def of(cls, scene: Scene, error: ClockError, usual: TimeSystem) -> SensorClock:
        """Return the clock of a sensor whose log usually has stamps of `usual`."""
        return cls(error, error.system or usual, gps_ns_from_utc(scene.start))

    def shown_gps_ns(self, epoch_gps_ns: Int64) -> Int64:
        """Return GPS time (ns, (n,)) that the clock shows at true epochs (n,)."""
        if self.error.is_right:
            return epoch_gps_ns
        elapsed_s = (epoch_gps_ns - self.start_gps_ns).astype(np.float64) / NS_PER_S
        wrong = self.error.offset_s + self.error.drift_ppm * 1e-6 * elapsed_s
        shown: Int64 = epoch_gps_ns + np.rint(wrong * NS_PER_S).astype(np.int64)
        return shown

    def stamps_ns(self, epoch_gps_ns: Int64) -> Int64:
        """Return stamps (ns of the system's count, (n,)) at true epochs (n,)."""
        shown = self.shown_gps_ns(epoch_gps_ns)
        match self.system:
            case TimeSystem.GPS | TimeSystem.FREE:
                return shown
            case TimeSystem.GPS_WEEK:
                return shown % (WEEK_S * NS_PER_S)
            case TimeSystem.UNIX_GPS:
                return shown + GPS_EPOCH_UNIX_S * NS_PER_S
            case TimeSystem.UNIX_UTC:
                return shown + (GPS_EPOCH_UNIX_S - leap_seconds_at_gps(shown // NS_PER_S)) * NS_PER_S
        raise ConfigError(
            f"the simulator does not write stamps of the system '{self.system}'",
            expected="gps, gps_week_seconds, unix_gps, unix_utc or free",
        )

    def toml(self, unit: str | None, first_gps_ns: int) -> str:
        """Return the survey file's ``clock = …`` for a log whose first stamp is at `first_gps_ns`, in `unit`.

        Week and date are those that the clock shows then.
        """
        parts = [f'system = "{self.system}"']
        if unit is not None:
            parts.append(f'unit = "{unit}"')
        shown = self.shown_gps_ns(np.array([first_gps_ns]))
        if self.system is TimeSystem.GPS_WEEK:
            parts.append(f"week = {int(shown[0]) // (WEEK_S * NS_PER_S)}")
        if self.system is TimeSystem.UTC_HOUR:
            parts.append(f"date = {utc_from_gps_ns(int(shown[0])):%Y-%m-%d}")
        if self.error.known:
            parts += self._correction()
        elif self.system is TimeSystem.FREE:
            parts.append(f"offset_s = {_NOTHING_S!r}")
        return "{ " + ", ".join(parts) + " }"

    def _correction(self) -> list[str]:
        """Return the inverse of the stamp's formula. A clock that restarts each hour counts as one of POSIX seconds."""
        rate = self.error.drift_ppm * 1e-6
        system = TimeSystem.UNIX_UTC if self.system is TimeSystem.UTC_HOUR else self.system
        counting = SensorClock(self.error, system, self.start_gps_ns)
        reference_s = int(counting.stamps_ns(np.array([self.start_gps_ns]))[0]) / NS_PER_S
        offset_s = -self.error.offset_s or (_NOTHING_S if self.system is TimeSystem.FREE else 0.0)
        return [
            f"offset_s = {offset_s!r}",
            f"drift_ppm = {-rate / (1.0 + rate) * 1e6!r}",
            f"reference_s = {reference_s!r}",
        ]
