"""Stripes: straight bands of paint, whose edges lie where the contrast falls to half."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.assets.paint.components import CELL_M, SEED_CONTRAST, Component, Contrast
from roadscan.assets.quantiles import median
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.arrays import way_along

_DRIVE_STEP_M: Final = 1.0  # Distance of points along a drive (m).
_OVER_M: Final = 3.0
"""The direction is that of a chord of twice this length (m)."""
_FARTHEST_M: Final = 25.0  # No direction is known farther from all drives (m).


class RoadDirection:
    """Direction of the drive nearest to a place."""

    def __init__(self, place_m: Float64, direction_rad: Float64) -> None:
        self._place, self._direction = place_m, direction_rad

    @classmethod
    def of(cls, scene: Scene) -> RoadDirection:
        """Returns the directions of a scene's drives."""
        places, directions = [np.zeros((0, 2))], [np.zeros(0)]
        drive = scene.drive_xyh_m
        for number in np.unique(drive[:, 3]) if len(drive) else []:
            xy = drive[drive[:, 3] == number, :2]
            driven = way_along(xy)
            moved = np.concatenate([[True], np.diff(driven) > 1e-6])
            if np.count_nonzero(moved) < 2:
                continue
            at = np.arange(0.0, driven[-1] + _DRIVE_STEP_M, _DRIVE_STEP_M)
            place = _along(at, driven[moved], xy[moved])
            chord = _along(at + _OVER_M, driven[moved], xy[moved]) - _along(at - _OVER_M, driven[moved], xy[moved])
            places.append(place)
            directions.append(np.arctan2(chord[:, 1], chord[:, 0]))
        return cls(np.concatenate(places), np.concatenate(directions))

    def at(self, x_m: float, y_m: float) -> float:
        """Returns the direction (rad) anticlockwise from x; NaN where no drive is within 25 m."""
        if not self._direction.size:
            return float("nan")
        away = np.hypot(self._place[:, 0] - x_m, self._place[:, 1] - y_m)
        nearest = int(np.argmin(away))
        return float(self._direction[nearest]) if away[nearest] <= _FARTHEST_M else float("nan")


def _along(
    at: npt.NDArray[np.float64], driven: npt.NDArray[np.float64], xy: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Returns points (n, 2) at lengths along a line, clamped to its ends."""
    return np.stack([np.interp(at, driven, xy[:, i]) for i in (0, 1)], axis=1)


CHUNK_M: Final = 5.0
"""Long components are cut at multiples of this in the map (m), so that each piece is straight."""
_LONGEST_WHOLE_M: Final = 7.0  # Longer components are cut (m).
WIDEST_M: Final = 0.7
"""Widest band (m): lines, and bars of crossings and stops."""
_SLIMMEST: Final = 2.0
"""Least ratio of length to width of a band."""
_SHORTEST_M: Final = 0.35  # Shortest band (m).
_BESIDE_M: Final = 0.25  # Width of the surface beside a band that is compared (m).
AROUND_M: Final = 0.08
"""Returns this near to paint (m) may lie on it: ranges and poses are not exact, and edges not straight."""
_SEEN_ASIDE_M: Final = 0.05  # Ground within this distance beside a band (m) shows its ends.
_EDGE_M: Final = 0.03  # Returns this near to a band's side (m) belong to neither.
_BEND_M: Final = 0.02
"""Greatest rise or fall of a road's surface at its lines (m), against the mean of both sides."""
_UNEVEN: Final = 0.5
"""Paint lies on one surface: its sides differ by less than this share of its contrast to them, or it is as bright as
paint against the brighter one too, as where fresh bitumen lies along a line."""
_STEEPEST: Final = 0.15  # Steepest ground (m/m).
_SIDE_STEP_M: Final = 0.04  # Greatest step between a band and one side (m).
_TWO_SHORTEST_M: Final = 1.0  # Shortest band that may be a double line (m).
_LEAST_APART_M: Final = 0.12
"""Least length of two lines side by side, and least distance of their middles (m)."""
_WIDER: Final = 1.5  # Greatest ratio of the widths of a double line.
_ALONG_ROAD: Final = 0.35
"""Sine of the greatest angle between a double line and the road; at a larger one it is no lane line."""
_TURNS_RAD: Final = np.linspace(-0.06, 0.06, 13)  # Turns that are tried (rad).
_BIN_M, _BINS = 0.03, 20
"""Width of the bins of contrast across (m), and their number on each side."""
_FEWEST_IN_BIN: Final = 3  # With fewer returns a bin counts as bare.
_PIECE_M: Final = 0.7
"""Length of the pieces in which the middle of a band is sought (m)."""
_FEWEST: Final = 8  # With fewer returns there is no band.


@dataclass(frozen=True, eq=False)
class Stripe:
    """A straight band: x, y from the corner of the scene's returns."""

    middle_m: Float64
    """(2,) point on its centre line."""
    along: Float64
    """(2,) unit vector along it."""
    begin_m: float
    end_m: float
    """Its ends along the centre line, from `middle_m`."""
    width_m: float
    contrast: float
    """Mean contrast of its core."""
    returns: Int64
    """(n,) returns within it, indices of the contrast's."""
    around: Int64
    """(m,) returns within `AROUND_M` of it."""
    sigma_across_m: float
    begin_seen: bool
    end_seen: bool
    """True where unpainted ground was seen beyond the end."""
    probability: float

    @property
    def length_m(self) -> float:
        """Returns the length of the band."""
        return self.end_m - self.begin_m

    @property
    def outline(self) -> shapely.Polygon:
        """Returns its rectangle."""
        aside = self.width_m / 2 * np.array([-self.along[1], self.along[0]])
        begin, end = self.at(self.begin_m), self.at(self.end_m)
        return shapely.Polygon([begin - aside, end - aside, end + aside, begin + aside])

    def at(self, along_m: float) -> Float64:
        """Returns a point (2,) of the centre line."""
        out: Float64 = self.middle_m + along_m * self.along
        return out

    def coordinates(self, x_m: Float64, y_m: Float64) -> tuple[Float64, Float64]:
        """Returns coordinates along and across (to the left) of points (n,), from `middle_m`."""
        dx, dy = x_m - self.middle_m[0], y_m - self.middle_m[1]
        return dx * self.along[0] + dy * self.along[1], dy * self.along[0] - dx * self.along[1]


def stripes_of(
    found: Contrast, component: Component, corner_m: tuple[float, float], road: RoadDirection
) -> list[Stripe] | None:
    """Bands of a component, end to end or side by side; None if it has another shape or is an edge of surfaces."""
    axis = _axis(component.cell_x_m, component.cell_y_m)
    if axis is None:
        return None
    middle, along, length, width, rms = axis
    turned = np.arctan2(along[1], along[0]) - road.at(*middle)
    if _TWO_SHORTEST_M <= length <= _LONGEST_WHOLE_M and abs(np.sin(turned)) <= _ALONG_ROAD:
        halves = _side_by_side(found, component, middle, along)
        both = [stripe for half in halves or () for stripe in stripes_of(found, half, corner_m, road) or ()]
        if len(both) == 2 and _are_alike(*both):
            return both
    straight = rms <= 1.3 * width / np.sqrt(12.0) + 0.02
    if length > _LONGEST_WHOLE_M or (not straight and length > 4 * CELL_M + 2.5 * width):
        return _of_parts(found, component, (middle, along, length), corner_m, road)
    if not straight or length < _SHORTEST_M or width > WIDEST_M + 0.15 or length < _SLIMMEST * width:
        return None
    start = Stripe(
        middle, along, -length / 2, length / 2, width, 0.0, component.near, component.near,
        0.0, False, False, component.probability,
    )  # fmt: skip
    stripe = fitted(found, start)
    if stripe is not None and _is_an_edge(found, component, stripe):
        return []
    if stripe is None or stripe.width_m > WIDEST_M or stripe.length_m < max(_SHORTEST_M, _SLIMMEST * stripe.width_m):
        return None
    return [stripe]


def _side_by_side(
    found: Contrast, component: Component, middle: Float64, along: Float64
) -> tuple[Component, Component] | None:
    """Both lines of a double one whose cells touch; None unless the contrast across falls to less than half between.

    The direction is that in which the contrast across varies most.
    """
    contrast = found.contrast[component.near]
    cells = np.stack([component.cell_x_m, component.cell_y_m], axis=1) - middle
    returns = np.stack([found.x_m[component.near], found.y_m[component.near]], axis=1) - middle
    profiles = []
    for turn in _TURNS_RAD:
        normal = np.array([-np.sin(turn) * along[0] - np.cos(turn) * along[1],
                           np.cos(turn) * along[0] - np.sin(turn) * along[1]])  # fmt: skip
        number = np.floor(returns @ normal / _BIN_M).astype(np.int64) + _BINS
        held = (number >= 0) & (number < 2 * _BINS)
        count = np.bincount(number[held], minlength=2 * _BINS)
        total = np.bincount(number[held], weights=contrast[held], minlength=2 * _BINS)
        profiles.append((np.where(count >= _FEWEST_IN_BIN, total / np.maximum(count, 1), 0.0), normal))
    level, normal = max(profiles, key=lambda one: float(np.sum(one[0] ** 2)))
    # The other line is where the level rises most above the lowest one on the way from the brightest place.
    at = int(np.argmax(level))
    lowest = np.concatenate([np.minimum.accumulate(level[at::-1])[::-1], np.minimum.accumulate(level[at:])[1:]])
    other = int(np.argmax(level - lowest))
    first, last = min(at, other), max(at, other)
    low = np.flatnonzero(level[first : last + 1] < 0.5 * level[other])
    if (last - first) * _BIN_M < _LEAST_APART_M or level[other] < SEED_CONTRAST / 2 or low.size < 2:
        return None
    cut = (first + float(low.mean()) + 0.5 - _BINS) * _BIN_M
    left, left_cells = returns @ normal > cut, cells @ normal > cut
    return component.part(left_cells, left), component.part(~left_cells, ~left)


def _are_alike(one: Stripe, other: Stripe) -> bool:
    """Returns True for two lines that may be a double one: neither is short, and their widths are similar."""
    narrow, wide = sorted((one.width_m, other.width_m))
    return min(one.length_m, other.length_m) >= _TWO_SHORTEST_M and wide <= _WIDER * narrow


def fitted(found: Contrast, start: Stripe) -> Stripe | None:
    """Stripe with its middle, direction, width and ends fitted to the returns of `start`; None if none fits."""
    stripe, near = start, start.returns
    if near.size < _FEWEST:
        return None
    x, y, contrast, noise = found.x_m[near], found.y_m[near], found.contrast[near], found.noise[near]
    for _ in range(2):
        along, across = stripe.coordinates(x, y)
        within = (along >= stripe.begin_m) & (along <= stripe.end_m)
        core = within & (np.abs(across) <= max(stripe.width_m / 4, 0.025))
        if np.count_nonzero(core) < 3:
            return None
        level = float(np.mean(contrast[core]))
        beside = within & (np.abs(across) <= stripe.width_m / 2 + _BESIDE_M)
        turned = _centred(stripe, along[beside], across[beside], contrast[beside] - level / 2)
        if turned is None:
            return None
        stripe = turned
        along, across = stripe.coordinates(x, y)
        band = np.abs(across) <= max(0.4 * stripe.width_m, 0.025)
        ends = _most(along[band], contrast[band] - level / 2)
        if ends is None:
            return None
        stripe = replace(stripe, begin_m=ends[0], end_m=ends[1], contrast=level)
    inside = (along >= stripe.begin_m) & (along <= stripe.end_m) & (np.abs(across) <= stripe.width_m / 2)
    if np.count_nonzero(inside) < _FEWEST:
        return None
    count = np.count_nonzero(inside)
    scatter = float(np.mean(noise[inside])) / max(stripe.contrast, 1e-3)
    sigma = float(np.hypot(stripe.width_m * scatter, 0.03) / np.sqrt(count) + 0.002)
    seen = [  # of bare ground beyond the start, and beyond the end
        bool(np.any((np.abs(across) <= stripe.width_m / 2 + _SEEN_ASIDE_M) & beyond))
        for beyond in (
            (along < stripe.begin_m) & (along > stripe.begin_m - 0.3),
            (along > stripe.end_m) & (along < stripe.end_m + 0.3),
        )
    ]
    reach = (along >= stripe.begin_m - AROUND_M) & (along <= stripe.end_m + AROUND_M)
    around = near[reach & (np.abs(across) <= stripe.width_m / 2 + AROUND_M) & ~inside]
    stripe = replace(stripe, begin_seen=seen[0], end_seen=seen[1])
    return replace(stripe, returns=near[inside], around=around, sigma_across_m=sigma)


def _is_an_edge(found: Contrast, component: Component, stripe: Stripe) -> bool:
    """True where two surfaces meet: the ground bends or steps across the stripe, or one side is much brighter."""
    near = component.near
    along, across = stripe.coordinates(found.x_m[near], found.y_m[near])
    within = (along >= stripe.begin_m) & (along <= stripe.end_m)
    beyond = np.abs(across) - stripe.width_m / 2
    heights, levels = [], []
    for mine in (beyond <= 0, (across > 0) & (beyond > _EDGE_M), (across < 0) & (beyond > _EDGE_M)):
        there = near[within & mine & (beyond <= _BESIDE_M)]
        heights.append(median(found.height_m[there]) if there.size >= 3 else np.nan)
        levels.append(median(found.contrast[there]) if there.size >= 3 else np.nan)
    inside, left, right = heights
    bend, slope = abs((left + right) / 2 - inside), abs(left - right) / (stripe.width_m + _EDGE_M + _BESIDE_M)
    lone = max(np.nan_to_num(abs(left - inside)), np.nan_to_num(abs(right - inside)))
    above = levels[0] - (levels[1] + levels[2]) / 2
    uneven = abs(levels[1] - levels[2]) > _UNEVEN * above and levels[0] - max(levels[1], levels[2]) < SEED_CONTRAST
    return bool(bend > _BEND_M or slope > _STEEPEST or lone > _SIDE_STEP_M or uneven)


def _centred(stripe: Stripe, along: Float64, across: Float64, excess: Float64) -> Stripe | None:
    """Returns the stripe turned and moved onto the middle of the paint, with its width."""
    pieces = max(1, int(stripe.length_m / _PIECE_M))
    if pieces >= 2:
        number = np.clip(((along - stripe.begin_m) / stripe.length_m * pieces).astype(np.int64), 0, pieces - 1)
        at, middle, weight = [], [], []
        for k in range(pieces):
            mine = number == k
            edges = _most(across[mine], excess[mine])
            if edges is not None:
                at.append(float(np.mean(along[mine])))
                middle.append((edges[0] + edges[1]) / 2)
                weight.append(float(np.sqrt(np.count_nonzero(mine))))
        if len(at) >= 2:
            slope, offset = _line(np.array(at), np.array(middle), np.array(weight))
            turned = stripe.along + slope * np.array([-stripe.along[1], stripe.along[0]])
            turned /= np.hypot(*turned)
            origin = stripe.middle_m + offset * np.array([-stripe.along[1], stripe.along[0]])
            across = across - offset - slope * along
            stripe = replace(stripe, middle_m=origin, along=turned)
    edges = _most(across, excess)
    if edges is None or edges[1] - edges[0] < 0.03:
        return None
    shift = (edges[0] + edges[1]) / 2
    middle_m = stripe.middle_m + shift * np.array([-stripe.along[1], stripe.along[0]])
    return replace(stripe, middle_m=middle_m, width_m=edges[1] - edges[0])


def _line(at: Float64, value: Float64, weight: Float64) -> tuple[float, float]:
    """Slope and offset at 0 of a line through values, by weighted least squares in which outliers count less."""
    slope = offset = 0.0
    for _ in range(3):
        w = weight / weight.sum()
        a, v = float(w @ at), float(w @ value)
        spread = float(w @ (at - a) ** 2)
        slope = float(w @ ((at - a) * (value - v))) / spread if spread > 1e-6 else 0.0
        offset = v - slope * a
        residual = np.abs(value - offset - slope * at)
        weight = weight / (1.0 + (residual / max(2.0 * median(residual), 0.01)) ** 2)
    return slope, offset


def _most(place: Float64, excess: Float64) -> tuple[float, float] | None:
    """Returns the interval over which the excess of contrast over half of the paint's has the greatest sum.

    Its ends are where the mean contrast passes through half, whatever the density of returns on either side.
    """
    if place.size < 3:
        return None
    order = np.argsort(place, kind="stable")
    place, total = place[order], np.concatenate([[0.0], np.cumsum(excess[order])])
    lowest = np.minimum.accumulate(total)
    gain = total - lowest
    last = int(np.argmax(gain))
    if gain[last] <= 0.0:
        return None
    first = int(np.argmin(total[: last + 1]))
    begin, end = place[first], place[last - 1]
    if first > 0:
        begin = (begin + place[first - 1]) / 2
    if last < place.size:
        end = (end + place[last]) / 2
    return float(begin), float(end)


def _axis(x: Float64, y: Float64) -> tuple[Float64, Float64, float, float, float] | None:
    """Returns middle, direction, length, mean width and scatter across of cells."""
    if x.size < 4:
        return None
    middle = np.array([x.mean(), y.mean()])
    dx, dy = x - middle[0], y - middle[1]
    xx, xy, yy = float(dx @ dx), float(dx @ dy), float(dy @ dy)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    along = np.array([np.cos(angle), np.sin(angle)])
    s, o = dx * along[0] + dy * along[1], dy * along[0] - dx * along[1]
    length = float(s.max() - s.min()) + CELL_M
    middle = middle + along * float(s.max() + s.min()) / 2
    return middle, along, length, x.size * CELL_M**2 / length, float(np.sqrt(np.mean(o**2)))


def _of_parts(
    found: Contrast,
    component: Component,
    axis: tuple[Float64, Float64, float],
    corner_m: tuple[float, float],
    road: RoadDirection,
) -> list[Stripe] | None:
    """Stripes of the pieces of a component, cut at multiples of `CHUNK_M` in the map, or halved where it is short."""
    middle, along, length = axis
    x, y = found.x_m[component.near], found.y_m[component.near]
    east = abs(along[0]) >= abs(along[1])
    corner = corner_m[0] if east else corner_m[1]
    of_cells = np.floor((corner + (component.cell_x_m if east else component.cell_y_m)) / CHUNK_M)
    of_returns = np.floor((corner + (x if east else y)) / CHUNK_M)
    if length <= _LONGEST_WHOLE_M or of_cells.min() == of_cells.max():  # a wide one may lie askew between two cuts
        of_cells = (
            (component.cell_x_m - middle[0]) * along[0] + (component.cell_y_m - middle[1]) * along[1] >= 0
        ).astype(np.float64)
        of_returns = ((x - middle[0]) * along[0] + (y - middle[1]) * along[1] >= 0).astype(np.float64)
    stripes: list[Stripe] = []
    lost = 0
    for number in np.unique(of_cells):
        cells = of_cells == number
        part = component.part(cells, of_returns == number)
        some = stripes_of(found, part, corner_m, road)
        if some is None:
            lost += int(np.count_nonzero(cells))
        else:
            stripes += some
    return stripes if lost <= 0.25 * component.cell.size else None
