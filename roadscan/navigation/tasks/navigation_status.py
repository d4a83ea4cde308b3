"""Status of computed trajectories and estimated clocks, for `roadscan status`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from roadscan.core.errors import ConfigError, DamagedError
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.survey import Survey
from roadscan.core.witness import Finding, Witness
from roadscan.navigation.tasks.navigate import plan_trajectories
from roadscan.navigation.tasks.navigation_pictures import picture_path
from roadscan.navigation.tasks.odometry_trajectory import LOCAL_MAP, ODOMETRY
from roadscan.navigation.tasks.solve_trajectory import PlannedTrajectory
from roadscan.navigation.tasks.trajectories import clock_picture_path, clock_unit, kept_estimates
from roadscan.store.logs import NAVIGATION, LogRecord, has_log
from roadscan.store.store import Store


@dataclass
class NavigationStatus:
    """Status of computed trajectories and clocks; damaged tables are left out."""

    trajectories: list[dict[str, Any]] = field(default_factory=list)
    """A computed trajectory of each run that has or awaits one: run, state, poses, epochs, σ, outliers, doubts,
    picture."""
    clocks: list[dict[str, Any]] = field(default_factory=list)
    """Estimated clocks."""

    @property
    def is_complete(self) -> bool:
        """True where no trajectory is due."""
        return all(one["state"] == "computed" for one in self.trajectories)

    def lines(self) -> Iterator[str]:
        """Return a line for each of them."""
        for one in self.trajectories:
            yield f"trajectory of run '{one['run']}': {_trajectory_words(one)}"
        for one in self.clocks:
            yield (
                f"clock of {one['run']}/{one['sensor']}: {one['offset_s']:+.6f} s ± {one['sigma_ms']:.2g} ms, drift "
                f"{one['drift_ppm']:+.3f} ± {one['sigma_drift_ppm']:.2g} ppm, from {one['method']}{_shown(one)}"
            )


COMPUTED_POSES: Final = Witness(
    "computed_poses",
    input="gnss, imu, encoder",
    fault="A measurement, its stated σ or a lever arm is wrong, and with it the trajectory that is computed of them.",
    asks="each measurement's innovation and residual in the smoother, by kind",
    does="outliers get no weight; a trajectory that its measurements contradict is kept, and named",
    told=("findings",),
)


def trajectory_findings(records: Iterable[LogRecord]) -> list[Finding]:
    """Return computed trajectories that their measurements contradict, a finding for each reason."""
    return [
        COMPUTED_POSES.finds(f"trajectory of run '{r.run}'", f"doubtful: {doubt}")
        for r in records
        if r.sensor == NAVIGATION
        for doubt in r.attributes.get("doubts", ())
    ] + [Finding.of(one) for r in records if r.sensor == NAVIGATION for one in r.attributes.get("findings", ())]


def navigation_status(
    survey: Survey, store: Store, logs: Sequence[LogRecord], records: Mapping[str, LogRecord]
) -> NavigationStatus:
    """Read records and small tables; reads no poses.

    Parameters
    ----------
    logs : records of the survey file's logs.
    records : all sound records of the store, by key.
    """
    found = NavigationStatus()
    try:
        planned = plan_trajectories(survey, store, logs)
        found.trajectories = [_trajectory(store, one, records.get(one.key)) for one in planned]
    except ConfigError:
        pass  # the run reports it
    with contextlib.suppress(DamagedError):  # `roadscan verify` reports it
        found.clocks = list(_clocks(store))
    return found


def _trajectory(store: Store, planned: PlannedTrajectory, record: LogRecord | None) -> dict[str, Any]:
    if record is None:
        state = "damaged" if has_log(store, planned.key) else "waiting"
        return {"run": planned.run, "state": state, "format": planned.format, "doubts": [], "picture": ""}
    attributes = record.attributes
    first, last = record.span("trajectory") or (0, 0)
    picture = picture_path(record.run)
    updates = attributes.get("updates", 0)
    names = [f"{which}_sigma_{axis}_m" for which in ("median", "largest") for axis in ("horizontal", "down")]
    return {
        "run": record.run,
        "state": "computed",
        "format": record.format,
        "poses": record.rows,
        "first": iso_from_gps_ns(first),
        "last": iso_from_gps_ns(last),
        "span_s": (last - first) / NS_PER_S,
        **{name: attributes[name] for name in names if name in attributes},
        "outlier_share": attributes["outliers"] / updates if updates else None,
        "measured_noise": attributes.get("measured_noise", {}),
        "doubts": [*attributes.get("doubts", ()), *(one["text"] for one in attributes.get("findings", ()))],
        "picture": picture if store.exists(picture) else "",
    }


def _trajectory_words(one: dict[str, Any]) -> str:
    if one["state"] != "computed":
        return f"{one['state']}, the next run computes it"
    parts = [f"{one['poses']:,} poses by the {one['format']}, {one['first']} to {one['last']} ({one['span_s']:,.1f} s)"]
    if "median_sigma_down_m" in one:
        parts.append(
            "σ median / largest: horizontal {median_sigma_horizontal_m:.3f} / {largest_sigma_horizontal_m:.3f} m, "
            "down {median_sigma_down_m:.3f} / {largest_sigma_down_m:.3f} m".format_map(one)
        )
    if one["outlier_share"] is not None:
        parts.append(f"{one['outlier_share']:.1%} of the updates are outliers")
    if one["format"] == ODOMETRY:
        parts.append(LOCAL_MAP)
    parts.append("doubtful" if one["doubts"] else "not doubted")
    return "; ".join(parts) + _shown(one)


def _shown(one: dict[str, Any]) -> str:
    return f"; picture {one['picture']}" if one["picture"] else ""


def _clocks(store: Store) -> Iterator[dict[str, Any]]:
    for one in kept_estimates(store, with_residuals=False):
        picture = clock_picture_path(clock_unit(one.run, one.sensor, one.applied))
        yield {
            "run": one.run,
            "sensor": one.sensor,
            "method": one.method,
            "offset_s": one.correction.offset_s,
            "sigma_ms": 1e3 * one.correction.sigma_offset_s,
            "drift_ppm": 1e6 * one.correction.drift,
            "sigma_drift_ppm": 1e6 * one.correction.sigma_drift,
            "picture": picture if store.exists(picture) else "",
        }
