"""Ties and control of a straight road, drawn with known statistics: what an adjustment gets, and the truth.

All runs drive north at one speed. A run's truth is drawn at every epoch that is asked for, without knots: the exact
recursion of a first-order Gauss–Markov process over irregular steps (Gelb 1974, 3.8).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roadscan.adjust.observations import FIXED, KINDS, GaussMarkov, Observations, RunPrior, partials

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

START_GPS_NS = 1_400_000_000 * 10**9
ALTITUDE_M = 2.0
"""Of the body's origin above the road."""
NORTH, EAST, DOWN = np.eye(3)

POSTPROCESSED = (
    GaussMarkov(0.010, 120.0),
    GaussMarkov(0.010, 120.0),
    GaussMarkov(0.015, 120.0),
    GaussMarkov(np.radians(0.004), 60.0),
    GaussMarkov(np.radians(0.004), 60.0),
    GaussMarkov(np.radians(0.008), 60.0),
)
"""Errors of a post-processed trajectory, north, east, down, roll, pitch, heading."""


@dataclass(frozen=True)
class Road:
    """What is driven, and what is seen."""

    length_m: float
    runs: int
    tie_spacing_m: float
    control_spacing_m: float
    lane_m: float = 0.0
    """From the track of one run to that of the next; ties lie half-way."""
    edge_m: float = 1.75
    """Control points lie so far to the right of a run's track."""
    speed_m_s: float = 100 / 3.6
    height_tie_sigma_m: float = 0.0003
    shift_tie_sigma_m: float = 0.002
    seen_height_sigma_m: float = 0.0003
    """Of a control point's height as one run sees it."""
    seen_place_sigma_m: float = 0.001
    survey_height_sigma_m: float = 0.002
    survey_place_sigma_m: float = 0.003
    processes: tuple[GaussMarkov, ...] = POSTPROCESSED

    def priors(self) -> list[RunPrior]:
        """The true statistics of each run."""
        last = START_GPS_NS + int(self.length_m / self.speed_m_s * 1e9)
        return [RunPrior(f"run{i:02}", START_GPS_NS, last, self.processes) for i in range(self.runs)]  # type: ignore[arg-type]

    def epochs(self, station_m: Float64) -> Int64:
        """Epoch of every run at stations."""
        return START_GPS_NS + np.round(station_m / self.speed_m_s * 1e9).astype(np.int64)

    @property
    def ties_m(self) -> Float64:
        """Stations of the places of ties."""
        return np.arange(0.5 * self.tie_spacing_m, self.length_m, self.tie_spacing_m)

    @property
    def control_m(self) -> Float64:
        """Stations of the control points, from end to end."""
        return np.linspace(0.0, self.length_m, round(self.length_m / self.control_spacing_m) + 1)


@dataclass
class Drawn:
    """Errors of all runs at some stations, drawn once."""

    station_m: Float64
    error: Float64
    """(runs, stations, 6) that the recorded poses have, so that truth is recorded + error."""

    def at(self, run: int | Int64, station_m: Float64) -> Float64:
        """(n, 6) at stations that were asked for when it was drawn."""
        return np.asarray(self.error[run, np.searchsorted(self.station_m, station_m)])


def drawn_errors(road: Road, station_m: Float64, rng: np.random.Generator) -> Drawn:
    """True corrections of all runs at stations, sorted and without repetition."""
    stations = np.unique(station_m)
    sigma, tau = (np.array([getattr(p, name) for p in road.processes]) for name in ("sigma", "tau_s"))
    error = np.empty((road.runs, stations.size, 6))
    normal = rng.standard_normal(error.shape)
    error[:, 0] = sigma * normal[:, 0]
    keep = np.exp(-np.diff(stations)[:, None] / road.speed_m_s / tau)
    gain = sigma * np.sqrt(1.0 - keep**2)
    for k in range(1, stations.size):
        error[:, k] = keep[k - 1] * error[:, k - 1] + gain[k - 1] * normal[:, k]
    return Drawn(stations, error)


def arm_m(right_m: float) -> Float64:
    """A point of the road so far to the right of the track."""
    return np.array([0.0, right_m, ALTITUDE_M])


def derivatives(direction: Float64, right_m: float) -> Float64:
    """(6,) of a point's movement along a direction, by the corrections of a level pose that heads north."""
    return partials(direction[None], np.eye(3)[None], arm_m(right_m)[None])[0]


def ties(road: Road, drawn: Drawn, rng: np.random.Generator, *, shifts: bool = True) -> Observations:
    """Height, and shift, of each run against the next one at every place."""
    parts, stations = [], road.ties_m
    epochs, half = road.epochs(stations), 0.5 * road.lane_m
    for run in range(road.runs - 1):
        ends = drawn.at(run, stations), drawn.at(run + 1, stations)
        for number, direction in enumerate((DOWN, NORTH, EAST) if shifts else (DOWN,)):
            sigma = road.shift_tie_sigma_m if number else road.height_tie_sigma_m
            rows = derivatives(direction, half), derivatives(direction, -half)
            parts.append(
                _rows(
                    KINDS.index("shift_tie" if number else "height_tie"),
                    (run, run + 1), (epochs, epochs), (rows[0], -rows[1]),
                    ends[0] @ rows[0] - ends[1] @ rows[1] + sigma * rng.standard_normal(stations.size),
                    (sigma, 0.0), 2 * np.arange(stations.size) + (number > 0) + 2 * stations.size * run,
                    np.arange(stations.size),
                )
            )  # fmt: skip
    return _joined(parts)


def control(road: Road, drawn: Drawn, rng: np.random.Generator) -> Observations:
    """Each control point as each run sees it; its survey errs once for all of them."""
    stations = road.control_m
    epochs, parts, n = road.epochs(stations), [], stations.size
    for number, direction in enumerate((NORTH, EAST, DOWN)):
        upright = number == 2
        seen, survey = (
            (road.seen_height_sigma_m, road.survey_height_sigma_m)
            if upright
            else (road.seen_place_sigma_m, road.survey_place_sigma_m)
        )
        surveyed = survey * rng.standard_normal(n)
        for run in range(road.runs):
            row = derivatives(direction, road.edge_m)
            observed = drawn.at(run, stations) @ row + surveyed + seen * rng.standard_normal(n)
            kind = KINDS.index("control_height" if upright else "control_position")
            group = (run * n + np.arange(n)) * 2 + upright
            parts.append(
                _rows(kind, (run, FIXED), (epochs, 0 * epochs), (row, 0.0 * row), observed, (seen, survey),
                      group, np.arange(n))
            )  # fmt: skip
    return _joined(parts)


def _rows(
    kind: int,
    runs: tuple[int, int],
    epochs: tuple[Int64, Int64],
    rows: tuple[Float64, Float64],
    observed: Float64,
    sigmas: tuple[float, float],
    group: Int64,
    place: Int64,
) -> Observations:
    """Observations of one kind; `sigmas` are those of what was seen and of the survey."""
    n = observed.size
    return Observations(
        np.full(n, kind, np.uint8), np.tile(np.array(runs, np.int32), (n, 1)), np.stack(epochs, axis=1),
        np.tile(np.stack(rows), (n, 1, 1)), observed, np.full(n, sigmas[0]), group.astype(np.int64),
        place.astype(np.int64), np.full(n, sigmas[1]),
    )  # fmt: skip


def _joined(parts: list[Observations]) -> Observations:
    """Joined with the groups as they are: rows of one group lie in several parts."""
    names = parts[0].__dataclass_fields__
    return Observations(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})
