"""Intensity calibrated from the data themselves: a gain per sensor and laser, by range and by angle of incidence.

Places of half a metre on the ground are seen by several lasers, from several ranges. The reflectance of a place is
unknown, but the same for all of them; so differences within places show the gains (as Levinson and Thrun, 2010,
*Unsupervised calibration for multi-beam lasers*, do for one scanner). The logarithm of an intensity is modelled as

    log I = log ρ(place) + laser(sensor, laser) + range(sensor, r) + incidence(sensor, θ),

with functions of r and θ that are linear between nodes. It is fitted to the mean intensities themselves, zeros
included, as a generalised linear model with a logarithmic link (McCullagh and Nelder, 1989, section 8), so that dark
ground and coarse digital numbers leave no bias. What the data do not determine (the common factor, a trend that
range and incidence could both explain) is set to the smallest gains.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets.bins import sums_around
from roadscan.assets.kernels.beams import log_gains, meet_ground
from roadscan.assets.quantiles import median, quantiles, weighted_quantile
from roadscan.assets.scene import GroundModel, Returns, Scene
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.compute.arrays import scatter_about
from roadscan.compute.kernel_options import read_only

if TYPE_CHECKING:
    from scipy.sparse import csr_array


RANGE_NODES_M: Final = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 13.0, 17.0, 23.0, 32.0, 45.0, 64.0, 90.0])
"""Ranges of the gain curve (m): a quarter to a third apart, as the return falls with a power of the range."""
INCIDENCE_NODES_DEG: Final = np.array([0.0, 20.0, 40.0, 50.0, 60.0, 65.0, 70.0, 75.0, 79.0, 82.0, 85.0, 88.0, 90.0])
"""Angles of incidence of the gain curve (degrees): closer towards grazing, where it is steep."""
PLACE_M: Final = 0.5  # Edge of a place (m).
ON_GROUND_M: Final = 0.1
"""Returns within this height of the ground model (m) determine gains, and are on the ground."""
_MOST_PLACES: Final = 4000
"""Places of a sample; a counter keyed by place selects them."""
_SLOPE_OVER_M: Final = 5.0
"""Edge (m) of the square of seen ground whose plane gives the normal."""
_EVEN_M2: Final = 0.01
"""Added to the variance of places across the plane, so that a row of cells leaves it level across (m²)."""
_MOST_ROUNDS, _STILL = 60, 2e-3
"""The fit ends after so many rounds, or when no logarithmic gain moves by more."""
_EXCESS: Final = (-0.9, 2.0)  # Bounds of the excess of an intensity over its expectation (share).
_SCATTER, _LEAST_SCATTER = 0.3, 0.02  # σ of an intensity, and its least value (shares).
_LASER_PRIOR: Final = 0.7
"""Prior 1 σ of a laser's logarithmic gain."""
_LEAST_LASERS: Final = 6
"""The trend over ranges is a parabola; of fewer lasers nothing is left that it could not explain."""
_ITS_OWN, _TREND_ROUNDS = 0.2, 5
"""A logarithmic gain so far off the trend has a quarter of its weight; rounds of weighing."""
_DOUBT_PLACES: Final = 30.0
"""Places that speak as much for a laser's gain as a gain of 1 does: what one place reflects differs within it."""
_LEVEL_PRIOR: Final = 0.3
"""Prior 1 σ of the logarithmic gains of range and of incidence, as a root mean square over their nodes: on a level road
both show the same trend, and a sum of two large ones would pass on the noise of the normals."""
_FEWEST_OF_CONSTANT: Final = 200  # Places, seen by a laser each, that show that an intensity is always the same.
_BEND_PRIOR: Final = 0.05
"""Prior 1 σ of the second differences of the functions of range and incidence from node to node."""

GAINS_SCHEMA: Final = pa.schema(
    [
        pa.field("sensor", pa.string(), nullable=False),
        pa.field("term", pa.string(), nullable=False),
        pa.field("node", pa.float64(), nullable=False),
        pa.field("gain", pa.float64(), nullable=False),
        pa.field("sigma_log", pa.float64(), nullable=False),
        pa.field("places", pa.int64(), nullable=False),
    ]
)
"""Columns of the table ``intensity_gains``."""


@dataclass(frozen=True, eq=False)
class IntensitySample:
    """Intensities of a piece of the map: a row (m,) for each place that a laser of a sensor saw from one range."""

    key: tuple[float, float]
    """Corner of the piece: samples are sorted by their keys."""
    sensors: tuple[str, ...]
    place: Int64
    """(m,) number of the place within the sample."""
    sensor: Int64
    """(m,) index of `sensors`."""
    laser: Int64
    range_m: Float64
    incidence_deg: Float64
    intensity: Float64
    """(m,) mean intensity."""
    returns: Int64
    unit: float
    """Least positive intensity of the sample: the digital number."""


class _Terms(NamedTuple):
    """Unknowns of all sensors: indices at which the terms of each begin."""

    sensors: tuple[str, ...]
    lasers: tuple[Int64, ...]
    first: tuple[int, ...]
    unknowns: int


def intensity_sample(scene: Scene) -> IntensitySample:
    """Returns the intensities of a scene's returns on the ground, within its tile."""
    found, tile = scene.returns, scene.tile
    rows = np.flatnonzero((np.abs(scene.above_ground_m) <= ON_GROUND_M) & tile.holds(found.x_m, found.y_m))
    ground = found.at(rows)
    place = _places(ground)
    incidence = incidence_deg(ground, scene.ground)
    bin_of_range = np.searchsorted(RANGE_NODES_M, ground.range_m)
    keys = (bin_of_range, ground.laser, ground.sensor, place)
    order = np.lexsort(keys)
    new = np.zeros(order.size, np.bool_)
    new[:1] = True
    for key in keys:
        new[1:] |= np.diff(key[order].astype(np.int64)) != 0
    first = np.flatnonzero(new)
    size = np.diff(np.append(first, order.size))
    one = order[first]
    measured = (ground.range_m, incidence, ground.intensity.astype(np.float64))
    means = [np.add.reduceat(v[order], first) / size if size.size else v[:0] for v in measured]
    return IntensitySample(
        key=found.corner_m,
        sensors=found.sensors or tuple(str(i) for i in range(int(found.sensor.max(initial=0)) + 1)),
        place=place[one],
        sensor=ground.sensor[one].astype(np.int64),
        laser=ground.laser[one].astype(np.int64),
        range_m=means[0],
        incidence_deg=means[1],
        intensity=means[2],
        unit=float(ground.intensity[ground.intensity > 0].min(initial=np.inf)),
        returns=size.astype(np.int64),
    )


def gains_of(samples: Sequence[IntensitySample]) -> pa.Table:
    """Returns gains (:data:`GAINS_SCHEMA`) that explain the samples best, the same for any order of them.

    Iterated least squares: the unknown reflectance of each place is eliminated, rows that do not fit (paint that one
    laser saw and another did not) weigh less (Geman–McClure). An empty table of no samples.
    """
    rows = _together(samples)
    if not rows.place.size:
        return GAINS_SCHEMA.empty_table()
    terms = _terms_of(rows)
    columns, values = _design(rows, terms)
    matrix = _matrix(columns, values, terms.unknowns)
    solution, covariance = np.zeros(terms.unknowns), np.zeros((terms.unknowns, terms.unknowns))
    robust, scale = np.ones(rows.place.size), 1.0
    for _ in range(_MOST_ROUNDS):
        before = solution
        response = (values * solution[columns]).sum(axis=1)
        mean = _place_means(rows, response, robust)
        excess = np.clip(rows.intensity / mean - 1.0, *_EXCESS)
        weights = robust * np.minimum(rows.returns, 9) / (1.0 + (rows.unit / (2.0 * _SCATTER * mean)) ** 2)
        solution, covariance = _solved(rows, matrix, (np.log(mean) + excess, weights), scale, terms)
        deviation = _without_places(rows, excess, weights)
        scale = max(scatter_about(deviation, 0.0), _LEAST_SCATTER)
        robust = 1.0 / (1.0 + (deviation / (3.0 * scale)) ** 2) ** 2
        if np.abs(solution - before).max() <= _STILL:
            break
    solution -= _common_part(rows, terms, (columns, values), solution)
    told = np.bincount(columns.ravel(), weights=(values.ravel() > 0.0).astype(np.float64), minlength=terms.unknowns)
    told = told.astype(np.int64)
    alone = _without_trend(rows, terms, columns[:, 0], solution, told)
    return _table(terms, solution, alone, np.sqrt(np.diag(covariance)), told)


def _without_trend(
    rows: IntensitySample, terms: _Terms, laser: Int64, solution: Float64, told: Int64
) -> Float64:  # fmt: skip
    """Returns the logarithmic responses (k,) of lasers without what the ranges of their ground could explain.

    On a level road a laser sees the ground at one range alone: what is smooth over ranges may be that of the range, or
    of the angle of incidence, which says nothing of things that stand upright. laser : (m,) the unknown of each row.
    """
    out = np.zeros(terms.unknowns)
    total = np.bincount(laser, weights=np.log(np.maximum(rows.range_m, RANGE_NODES_M[0])), minlength=terms.unknowns)
    for lasers, first in zip(terms.lasers, terms.first, strict=True):
        own = slice(first, first + lasers.size)
        if lasers.size >= _LEAST_LASERS:
            u, weight = total[own] / told[own], told[own] / (told[own] + _DOUBT_PLACES)
            past = np.zeros(lasers.size)
            for _ in range(_TREND_ROUNDS):
                trend = np.polyfit(u - u.mean(), solution[own], 2, w=np.sqrt(weight) / (1.0 + (past / _ITS_OWN) ** 2))
                past = solution[own] - np.polyval(trend, u - u.mean())
            out[own] = weight * past
    return out


def light_of(samples: Sequence[IntensitySample], gains: pa.Table) -> float | None:
    """Returns the median calibrated intensity of the returns of the samples; None of none."""
    nodes_of = log_gains_by_node(gains)
    light, weight = [np.zeros(0)], [np.zeros(0)]
    for sample in samples:
        log_gain = np.zeros(sample.place.size)
        for number, name in enumerate(sample.sensors):
            mine = sample.sensor == number
            for term, at in (("laser", sample.laser), ("range", sample.range_m), ("incidence", sample.incidence_deg)):
                nodes, logs = nodes_of(name, term)
                if nodes.size and mine.any():
                    log_gain[mine] += np.interp(at[mine], nodes, logs)
        light.append(sample.intensity * np.exp(log_gain))
        weight.append(sample.returns.astype(np.float64))
    values, weights = np.concatenate(light), np.concatenate(weight)
    if not values.size:
        return None
    return weighted_quantile(values, weights, 0.5)


def constant_intensities(samples: Sequence[IntensitySample]) -> dict[str, float]:
    """Returns the intensity of sensors whose returns on the ground all have the same, but for one in a thousand."""
    values: dict[str, list[Float64]] = {}
    for sample in samples:
        for number in np.unique(sample.sensor).tolist():
            values.setdefault(sample.sensors[number], []).append(sample.intensity[sample.sensor == number])
    joined = {sensor: np.concatenate(some) for sensor, some in sorted(values.items())}
    return {
        sensor: median(one)
        for sensor, one in joined.items()
        if one.size >= _FEWEST_OF_CONSTANT and np.ptp(quantiles(one, [0.001, 0.999])) <= 1e-4 * abs(median(one))
    }


def log_gains_by_node(gains: pa.Table) -> Callable[[str, str], tuple[Float64, Float64]]:
    """Returns a function of a sensor and a term: its nodes (k,), ascending, and the logarithms of their gains."""
    sensors, terms = (gains[name].to_numpy(zero_copy_only=False) for name in ("sensor", "term"))
    nodes, logs = gains["node"].to_numpy(), np.log(gains["gain"].to_numpy())

    def of(sensor: str, term: str) -> tuple[Float64, Float64]:
        rows = np.flatnonzero((sensors == sensor) & (terms == term))
        rows = rows[np.argsort(nodes[rows])]
        return nodes[rows], logs[rows]

    return of


def _place_means(rows: IntensitySample, response: Float64, weights: Float64) -> Float64:
    """Expected intensity (m,) of each row: the reflectance of its place, from all its rows, times the response."""
    weighted = weights * rows.returns
    factor = np.exp(response)
    total = np.bincount(rows.place, weights=weighted * rows.intensity)
    place = total / np.maximum(np.bincount(rows.place, weights=weighted * factor), 1e-12)
    out: Float64 = np.maximum(place, rows.unit / 10.0)[rows.place] * factor
    return out


def calibrated(returns: Returns, ground: GroundModel, gains: pa.Table) -> Returns:
    """Returns the returns with calibrated intensity (`calibrated` true); the gain is 1 where the table lacks a laser.

    The angle of incidence is known on the ground; the gain of incidence of all other returns is 1.
    """
    log_gain, of_lasers = np.zeros(len(returns)), np.zeros(len(returns))
    on_ground = np.abs(returns.height_m - ground.height_at(returns.x_m, returns.y_m)) <= 3 * ON_GROUND_M
    range_m, incidence = _beams(returns, ground, on_ground)
    nodes_of = log_gains_by_node(gains)
    for number, name in enumerate(returns.sensors):
        mine = returns.sensor == number
        (lasers, of_laser), (_, alone) = nodes_of(name, "laser"), nodes_of(name, "laser alone")
        if not mine.any() or not lasers.size:
            continue
        by_laser, by_laser_alone = np.zeros((2, int(np.iinfo(np.uint16).max) + 1))
        by_laser[lasers.astype(np.int64)], by_laser_alone[lasers.astype(np.int64)] = of_laser, alone
        of_lasers[mine] = by_laser_alone[returns.laser[mine]]
        log_gains(mine, returns.laser, range_m, incidence, on_ground, by_laser,
                  nodes_of(name, "range"), nodes_of(name, "incidence"), log_gain)  # fmt: skip
    log_gain[np.isnan(log_gain)] = 0.0  # the sensor's place is not known
    intensity = (returns.intensity * np.exp(log_gain)).astype(np.float32)
    evened = (returns.intensity * np.exp(of_lasers)).astype(np.float32)
    return replace(returns, intensity=intensity, calibrated=True, evened=evened)


def calibrated_scene(scene: Scene, gains: pa.Table) -> Scene:
    """Returns the scene with calibrated intensities."""
    return replace(scene, returns=calibrated(scene.returns, scene.ground, gains))


def incidence_deg(returns: Returns, ground: GroundModel) -> Float64:
    """Returns the angle (n,) between each beam and the normal of the ground below its return (deg), 0 to 90.

    Where the ground is not known, it is assumed level.
    """
    return _beams(returns, ground, np.ones(len(returns), np.bool_))[1]


def _beams(returns: Returns, ground: GroundModel, wanted: Bool) -> tuple[Float64, Float64]:
    """Range (n,) of each return (m), and the angle of incidence of the wanted ones (deg); 0 of all others."""
    range_m, cosine = np.empty(len(returns)), np.empty(len(returns))
    place = tuple(map(read_only, (returns.x_m, returns.y_m, returns.height_m)))
    sensor = tuple(map(read_only, (returns.sensor_x_m, returns.sensor_y_m, returns.sensor_height_m)))
    grid = (float(ground.x_min_m), float(ground.y_min_m), float(ground.cell_m))
    meet_ground(place, sensor, grid, *_slopes(ground), wanted, range_m, cosine)
    return range_m, np.degrees(np.arccos(cosine, out=cosine), out=cosine)


def _slopes(ground: GroundModel) -> tuple[Float64, Float64]:
    """Slopes (rows, columns) to the east and to the north (m/m) of the least-squares plane through the cells around
    each cell in which ground was seen; 0 where there are none.
    """
    known = ground.seen & np.isfinite(ground.height_m)
    weight = known.astype(np.float64)
    size = 2 * int(_SLOPE_OVER_M / ground.cell_m / 2) + 1
    level = float(np.mean(ground.height_m[known], dtype=np.float64)) if known.any() else 0.0
    z = np.where(known, ground.height_m.astype(np.float64) - level, 0.0)
    y, x = (ground.cell_m * (at - at.mean()) for at in np.indices(z.shape).astype(np.float64))
    number = np.maximum(sums_around(weight, size), 1.0)

    def mean(value: Float64) -> Float64:
        return sums_around(weight * value, size) / number

    mx, my, mz = mean(x), mean(y), mean(z)
    xx, yy, xy = mean(x * x) - mx * mx + _EVEN_M2, mean(y * y) - my * my + _EVEN_M2, mean(x * y) - mx * my
    xz, yz = mean(x * z) - mx * mz, mean(y * z) - my * mz
    both = xx * yy - xy * xy
    return (yy * xz - xy * yz) / both, (xx * yz - xy * xz) / both


# --- the places of a sample ------------------------------------------------------------------------


def _places(ground: Returns) -> Int64:
    """Returns the number (n,) of the place of each return; −1 for places beyond those of a sample."""
    column = np.floor((ground.corner_m[0] + ground.x_m) / PLACE_M).astype(np.int64)
    row = np.floor((ground.corner_m[1] + ground.y_m) / PLACE_M).astype(np.int64)
    if not row.size:
        return row
    row, column = row - row.min(), column - column.min()
    flat = row * (int(column.max()) + 1) + column
    held = np.zeros(int(flat.max()) + 1, np.int64)
    held[flat] = 1
    return np.asarray(np.cumsum(held)[flat] - 1)


def _together(samples: Sequence[IntensitySample]) -> IntensitySample:
    """Returns all samples as one, in the order of their keys, without places that one group alone saw."""
    ordered = sorted(samples, key=lambda s: s.key)
    names = tuple(sorted({n for s in ordered for n in s.sensors}))
    first, parts = 0, []
    for sample in ordered:
        kept = _chosen(sample)
        number = np.array([names.index(n) for n in sample.sensors], np.int64)
        _, own = np.unique(sample.place[kept], return_inverse=True)
        parts.append((own + first, number[sample.sensor[kept]], *(v[kept] for v in _values(sample))))
        first += int(own.max(initial=-1)) + 1
    columns: list[npt.NDArray[Any]] = [np.zeros(0, np.int64)] * 7
    if parts:
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    unit = min((s.unit for s in ordered), default=1.0)
    place, sensor, laser, range_m, incidence, intensity, returns = columns
    digit = unit if np.isfinite(unit) else 1.0
    return IntensitySample((0.0, 0.0), names, place, sensor, laser, range_m, incidence, intensity, returns, digit)


def _values(sample: IntensitySample) -> tuple[npt.NDArray[Any], ...]:
    return sample.laser, sample.range_m, sample.incidence_deg, sample.intensity, sample.returns


def _chosen(sample: IntensitySample) -> Int64:
    """Returns rows of the places that two groups or more saw; of many such places an even choice."""
    if not sample.place.size:
        return np.zeros(0, np.int64)
    groups = np.bincount(sample.place)
    shared = np.flatnonzero(groups > 1)
    taken = np.zeros(groups.size, np.bool_)
    taken[shared[:: max(1, -(-shared.size // _MOST_PLACES))]] = True
    return np.flatnonzero(taken[sample.place])


# --- least squares ---------------------------------------------------------------------------------


def _terms_of(rows: IntensitySample) -> _Terms:
    lasers, first, count = [], [], 0
    for number in range(len(rows.sensors)):
        mine = np.unique(rows.laser[rows.sensor == number])
        lasers.append(mine)
        first.append(count)
        count += mine.size + RANGE_NODES_M.size + INCIDENCE_NODES_DEG.size if mine.size else 0
    return _Terms(rows.sensors, tuple(lasers), tuple(first), count)


def _design(rows: IntensitySample, terms: _Terms) -> tuple[Int64, Float64]:
    """Returns columns (m, 5) of the unknowns on which each row depends, and their factors (m, 5)."""
    size = rows.place.size
    columns, values = np.zeros((size, 5), np.int64), np.zeros((size, 5))
    for number, lasers in enumerate(terms.lasers):
        mine = np.flatnonzero(rows.sensor == number)
        start = terms.first[number]
        columns[mine, 0] = start + np.searchsorted(lasers, rows.laser[mine])
        values[mine, 0] = 1.0
        start += lasers.size
        for at, nodes, value in (
            (1, RANGE_NODES_M, rows.range_m[mine]),
            (3, INCIDENCE_NODES_DEG, rows.incidence_deg[mine]),
        ):
            place = np.clip(value, nodes[0], nodes[-1])
            left = np.clip(np.searchsorted(nodes, place, side="right") - 1, 0, nodes.size - 2)
            share = (place - nodes[left]) / (nodes[left + 1] - nodes[left])
            columns[mine, at], columns[mine, at + 1] = start + left, start + left + 1
            values[mine, at], values[mine, at + 1] = 1.0 - share, share
            start += nodes.size
    return columns, values


def _without_places(rows: IntensitySample, value: Float64, weights: Float64) -> Float64:
    """Returns values (m,) less the weighted mean of their place."""
    total = np.bincount(rows.place, weights=weights)
    mean = np.bincount(rows.place, weights=weights * value) / np.maximum(total, 1e-12)
    out: Float64 = value - mean[rows.place]
    return out


def _matrix(columns: Int64, values: Float64, unknowns: int) -> csr_array:
    """Returns factors (m, 5) as a matrix (m, unknowns)."""
    from scipy.sparse import csr_array

    at = np.repeat(np.arange(len(columns)), columns.shape[1])
    return csr_array((values.ravel(), (at, columns.ravel())), shape=(len(columns), unknowns))


def _solved(
    rows: IntensitySample,
    matrix: csr_array,
    observed: tuple[Float64, Float64],
    scale: float,
    terms: _Terms,
) -> tuple[Float64, Float64]:
    """Returns unknowns and their covariance: normal equations without the places' reflectances, with the priors.

    matrix : (m, unknowns) the design. observed : (m,) logarithmic intensities and their weights.
    """
    from scipy import sparse

    value, weights = observed
    size = rows.place.size
    order, ends = np.argsort(rows.place, kind="stable"), np.cumsum(np.append(0, np.bincount(rows.place)))
    in_place = sparse.csr_array((weights[order], order, ends), shape=(ends.size - 1, size))
    total = np.maximum(np.bincount(rows.place, weights=weights), 1e-12)
    sums = in_place @ matrix
    weighted = sparse.csr_array(matrix.multiply(weights[:, None]))
    normal = (matrix.T @ weighted - sums.T @ sums.multiply(1.0 / total[:, None])).toarray()
    right = matrix.T @ (weights * _without_places(rows, value, weights))
    full = normal / scale**2 + _prior(terms)
    covariance = np.linalg.inv(full)
    return covariance @ (right / scale**2), covariance


def _prior(terms: _Terms) -> Float64:
    """Returns the prior information (k, k): small gains, smooth in range and incidence."""
    out = np.zeros((terms.unknowns, terms.unknowns))
    for lasers, first in zip(terms.lasers, terms.first, strict=True):
        if not lasers.size:
            continue
        mine = np.arange(first, first + lasers.size)
        out[mine, mine] += 1.0 / _LASER_PRIOR**2
        start = first + lasers.size
        for nodes in (RANGE_NODES_M, INCIDENCE_NODES_DEG):
            some = slice(start, start + nodes.size)
            bends = np.diff(np.eye(nodes.size), n=2, axis=0)
            out[some, some] += bends.T @ bends / _BEND_PRIOR**2 + np.eye(nodes.size) / (_LEVEL_PRIOR**2 * nodes.size)
            start += nodes.size
    return out


def _common_part(rows: IntensitySample, terms: _Terms, design: tuple[Int64, Float64], solution: Float64) -> Float64:
    """Returns what to subtract from the unknowns (k,) of all lasers so that the mean gain of the rows is 1."""
    columns, values = design
    mean = float(np.average((values * solution[columns]).sum(axis=1), weights=rows.returns))
    out = np.zeros(terms.unknowns)
    for lasers, first in zip(terms.lasers, terms.first, strict=True):
        out[first : first + lasers.size] = mean
    return out


def _table(terms: _Terms, solution: Float64, alone: Float64, sigma: Float64, told: Int64) -> pa.Table:
    rows: list[tuple[str, str, float, float, float, int]] = []
    for name, lasers, first in zip(terms.sensors, terms.lasers, terms.first, strict=True):
        if not lasers.size:
            continue
        start = first
        for term, nodes in (
            ("laser", lasers.astype(np.float64)),
            ("range", RANGE_NODES_M),
            ("incidence", INCIDENCE_NODES_DEG),
        ):
            for i, node in enumerate(nodes, start):
                rows.append((name, term, float(node), float(np.exp(-solution[i])), float(sigma[i]), int(told[i])))
                if term == "laser":
                    gain = float(np.exp(-alone[i]))
                    rows.append((name, "laser alone", float(node), gain, float(sigma[i]), int(told[i])))
            start += len(nodes)
    rows.sort(key=lambda r: r[:3])
    columns = [pa.array(c, f.type) for c, f in zip(zip(*rows, strict=True), GAINS_SCHEMA, strict=True)]
    return pa.Table.from_arrays(columns, schema=GAINS_SCHEMA)
