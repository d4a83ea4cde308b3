"""Ties from heights: patches of a surface that profilers saw in several drives are matched with one another.

Readings become height images, one a sensor and drive. Where two images overlap, small patches are shifted against each
other until their heights agree (Lucas and Kanade 1981). A patch with relief or texture determines all three directions,
an even one the height alone, as its normal equations show. Cells are coarse at first and fine once the mountings are
close.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.calibrate.evidence import Seen, Ties, Traverse
from roadscan.calibrate.kernels.surface_patches import MOMENTS, UNKNOWNS, Matches, match_patches, splat
from roadscan.calibrate.surfaces.planes import LevelPoints, Pieces, Readings, level_from_world, placed
from roadscan.calibrate.unknowns import Estimate
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.errors import NavigationError
from roadscan.core.strict import Strict

_BLUR_CELLS: Final = 1.5
"""Images are smoothed with a Gaussian of this σ. With less, interpolation between cells would damp their noise and
draw shifts to half cells, where it does so most."""
_EDGE_CELLS: Final = 4
"""Cells this near to the edge of the seen area are left out: they are one-sided means."""
_INDEPENDENT: Final = 4.0 * math.pi * (_BLUR_CELLS**2 + 1.0 / 6.0)
"""Cells that count as one independent height: area under the correlation of the smoothed noise (bilinear splat too)."""
_FILLED: Final = 0.3
"""A cell counts as seen if it has this share of the usual weight."""
_WIDTH_M: Final = 2.0
"""Approximate width of a head's profiles."""
_MOST_CELLS: Final = 60_000_000  # Most cells of an image.
_ALIKE: Final = 0.9
"""Two drives have the same direction if the cosine of the angle between them exceeds this."""
_DIRECTION: Final = (0, 1, -1, 2, -2)  # Offsets (cells) at which a pose is searched for, the nearest first.


class HeightLevel(Strict):
    """One step from coarse to fine."""

    cell_m: float = Field(gt=0.0)
    """Edge of a cell (m)."""
    patch_m: float = Field(gt=0.0)
    """Edge of a patch (m)."""
    stride_m: float = Field(gt=0.0)
    """From patch to patch (m)."""
    reach_m: float = Field(gt=0.0)
    """Patches that would have to move farther are left out (m)."""
    steepest: float = Field(default=float("inf"), gt=0.0, allow_inf_nan=True)
    """Cells on steeper slopes (m/m) are left out: edges lie between two readings, and no interpolation finds them."""


class HeightSettings(Strict):
    """How patches of height images are tied."""

    levels: tuple[HeightLevel, ...] = (
        HeightLevel(cell_m=0.03, patch_m=1.0, stride_m=0.5, reach_m=0.4),
        HeightLevel(cell_m=0.03, patch_m=0.6, stride_m=0.3, reach_m=0.2),
        HeightLevel(cell_m=0.012, patch_m=0.36, stride_m=0.24, reach_m=0.04, steepest=2.0),
        HeightLevel(cell_m=0.0035, patch_m=0.24, stride_m=0.24, reach_m=0.008, steepest=1.3),
    )
    """From coarse to fine; the last one gives the result."""
    covered: float = Field(default=0.5, gt=0.0, le=1.0)
    """Share of a patch that both drives saw."""
    coherence: float = Field(default=0.4, gt=0.0, lt=1.0)
    """A direction counts where this share of the slopes' energy is common to both images; the rest is noise."""
    partners: int = Field(default=6, ge=1)
    """Drives that each sensor's drive is compared with."""
    sigma_floor_m: float = Field(default=2e-5, gt=0.0)
    """No tie is better than this (m, 1 σ): rounding, interpolation."""
    every: int = Field(default=3, ge=1)
    """Every so many cells of a patch are used; neighbours say the same."""
    iterations: int = Field(default=14, ge=1)
    """Steps of a patch at most."""
    settled: float = Field(default=0.02, gt=0.0)
    """Ties stay as they are where no reading has moved by this share of a cell since they were found."""


@dataclass(frozen=True)
class Image:
    """Heights that one sensor saw in one drive."""

    placed: LevelPoints
    height_m: Float64
    """(rows, columns); NaN where nothing was seen."""
    carrier: npt.NDArray[np.int32]
    """(rows, columns) pose of a reading in the cell; −1 for none."""
    corner_m: Float64
    """(2,) x and y of the centre of cell (0, 0), level axes."""
    cell_m: float

    def pose_at(self, place_m: Float64) -> Int64:
        """Return the pose (n,) of a reading within two cells of places (n, 2+); −1 for none."""
        cell = np.rint((place_m[:, :2] - self.corner_m) / self.cell_m).astype(np.int64)
        rows, columns = self.carrier.shape
        found = np.full(len(cell), -1, dtype=np.int64)
        for j, i in itertools.product(_DIRECTION, _DIRECTION):
            r, c = cell[:, 1] + j, cell[:, 0] + i
            inside = (found < 0) & (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
            found[inside] = self.carrier[r[inside], c[inside]]
        return found

    def height_at(self, place_m: Float64) -> Float64:
        """Return the height (n,) of the cell at places (n, 2+); NaN for none."""
        cell = np.rint((place_m[:, :2] - self.corner_m) / self.cell_m).astype(np.int64)
        rows, columns = self.height_m.shape
        inside = ((cell >= 0) & (cell < [columns, rows])).all(axis=1)
        out = np.full(len(cell), np.nan)
        out[inside] = self.height_m[cell[inside, 1], cell[inside, 0]]
        return out


@dataclass(frozen=True)
class Matched:
    """Patches of one image matched with another."""

    first: Image
    second: Image
    patch: Int64
    """(n,) number of each patch."""
    centre_m: Float64
    """(n, 2) x and y of its middle."""
    felt_m: Float64
    """(n, 3) centre of the slopes that determine its horizontal shift, in the first image."""
    shift_m: Float64
    """(n, 3) from the first image to the second."""
    upright: Float64
    """(n, 1, 3) row of the height: at the patch's middle, unit variance."""
    level: Float64
    """(n, 2, 3) rows of the horizontal directions at `felt_m`; zero for undetermined directions."""


@dataclass
class HeightTies:
    """Finds the ties of an estimate; the estimator takes it as its evidence.

    Parameters
    ----------
    readings : of all sensors and drives. pieces : how drives are cut.
    traverses : the pieces' errors of poses, as the estimator has them.
    settings : levels and limits.
    """

    readings: Sequence[Readings]
    pieces: Pieces
    traverses: Mapping[int, Traverse]
    settings: HeightSettings = field(default_factory=HeightSettings)
    _calls: int = 0
    _last: tuple[Estimate, list[Ties]] | None = None

    def __call__(self, estimate: Estimate) -> list[Ties]:
        """Ties with the places of this estimate, one level finer at each call."""
        level = min(self._calls, len(self.settings.levels) - 1)
        finest = level == len(self.settings.levels) - 1
        if finest and self._last is not None and self._is_settled(estimate, self._last[0]):
            return self._last[1]
        self._calls += 1
        ties = height_ties(self.readings, estimate, self.pieces, self.traverses, self.settings, level)
        self._last = (estimate, ties) if finest else None
        return ties

    def _is_settled(self, now: Estimate, before: Estimate) -> bool:
        limit = self.settings.settled * self.settings.levels[-1].cell_m
        for name in {one.sensor for one in self.readings}:
            (r, lever), (s, arm) = now.mountings[name].arrays(), before.mountings[name].arrays()
            farthest = max(
                float(np.abs(one.point_sensor_m).max(initial=0.0)) for one in self.readings if one.sensor == name
            )
            if np.abs(lever - arm).max() + farthest * np.abs(r - s).max() > limit:
                return False
        return True


def height_ties(
    readings: Sequence[Readings],
    estimate: Estimate,
    pieces: Pieces,
    traverses: Mapping[int, Traverse],
    settings: HeightSettings,
    level: int = -1,
) -> list[Ties]:
    """Return the ties between drives, and between sensors, at one level.

    Returns one :class:`Ties` for heights and one for horizontal shifts of each pair of sensors; none where nothing
    overlaps.
    """
    turned = level_from_world(readings)
    all_placed = [placed(one, estimate, pieces, traverses, turned) for one in readings]
    drift_m = pieces.drift_m(traverses)
    at = settings.levels[level]
    images = _images(all_placed, at)
    matched = [match(images[a], images[b], at, settings, drift_m) for a, b in _pairs(images, settings.partners)]
    matched = _shared([one for one in matched if one.patch.size])
    by_sensors: dict[tuple[str, str], list[Matched]] = {}
    for one in matched:
        names = one.first.placed.readings.sensor, one.second.placed.readings.sensor
        by_sensors.setdefault(names, []).append(one)
    return [ties for group in by_sensors.values() for ties in _ties(group, turned)]


def _images(all_placed: Sequence[LevelPoints], at: HeightLevel) -> list[Image]:
    low, high = _overlap([one.place_m for one in all_placed])
    columns, rows = (np.ceil((high - low) / at.cell_m).astype(int) + 1).tolist()
    if rows * columns > _MOST_CELLS:
        raise NavigationError(
            f"drives overlap over {high[0] - low[0]:.0f} m × {high[1] - low[1]:.0f} m",
            expected=f"at most {_MOST_CELLS:,} cells of {at.cell_m:g} m",
            change="state the area of the calibration object",
        )
    return [_image(one, low, rows, columns, at) for one in all_placed]


def _overlap(places: Sequence[Float64]) -> tuple[Float64, Float64]:
    """Return the corners (2,), (2,) of the box around the area that two or more clouds cover."""
    boxes = [
        (np.array([p[:, a].min() for a in (0, 1)]), np.array([p[:, a].max() for a in (0, 1)])) for p in places if len(p)
    ]
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for (a, b), (c, d) in itertools.combinations(boxes, 2):
        start, end = np.maximum(a, c), np.minimum(b, d)
        if (end > start).all():
            low, high = np.minimum(low, start), np.maximum(high, end)
    if not np.isfinite(low).all():
        raise NavigationError(
            "no place was seen twice: the drives do not overlap",
            expected="at least two drives over one place",
            change="check the runs, passes and area of this evidence",
        )
    return low, high


def _image(one: LevelPoints, corner_m: Float64, rows: int, columns: int, at: HeightLevel) -> Image:
    mass, height = np.zeros((rows, columns)), np.zeros((rows, columns))
    carrier = np.full((rows, columns), -1, dtype=np.int32)
    splat(
        one.place_m,
        one.readings.pose,
        float(corner_m[0]),
        float(corner_m[1]),
        at.cell_m,
        mass,
        height,
        carrier,
    )
    image = np.full((rows, columns), np.nan)
    hit = np.flatnonzero(mass.any(axis=1)), np.flatnonzero(mass.any(axis=0))
    if hit[0].size:
        part = tuple(slice(int(h[0]), int(h[-1]) + 1) for h in hit)
        image[part] = _smoothed(mass[part], height[part], at)
    return Image(one, image, carrier, corner_m, at.cell_m)


def _smoothed(mass: Float64, height: Float64, at: HeightLevel) -> Float64:
    """Return the heights of cells; NaN near the edge of the seen area and near slopes that are too steep."""
    from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

    mass, height = (gaussian_filter(a, _BLUR_CELLS, mode="constant", truncate=3.0) for a in (mass, height))
    near = 2 * _EDGE_CELLS + 1
    seen = minimum_filter(mass > _FILLED * float(np.median(mass[mass > 0])), near, mode="constant")
    image = np.full(mass.shape, np.nan)
    image[seen] = height[seen] / mass[seen]
    if math.isfinite(at.steepest) and min(image.shape) > 1:
        along, across = np.gradient(image, at.cell_m)
        image[maximum_filter(along**2 + across**2 > at.steepest**2, near)] = np.nan
    return image


def _pairs(images: Sequence[Image], partners: int) -> list[tuple[int, int]]:
    """Return pairs of overlapping images, each drive with about so many partner drives.

    Drives in other directions come first: two in the same direction see a wrong mounting alike, and their profiles lie
    side by side, so that texture finer than the profiles' spacing makes patterns that match where nothing does.
    """
    order = {drive: i for i, drive in enumerate(dict.fromkeys(one.placed.readings.drive for one in images))}
    place = [order[one.placed.readings.drive] for one in images]
    apart = {(i, j): min(abs(i - j), len(order) - abs(i - j)) for i in order.values() for j in order.values()}
    used: dict[int, int] = {}
    chosen = set()
    forward = {order[one.placed.readings.drive]: one.placed.rotation[:, :2, 0].mean(axis=0) for one in images}
    alike = {(i, j): bool(forward[i] @ forward[j] > _ALIKE) for i, j in apart}
    ranked = sorted(itertools.combinations(range(len(order)), 2), key=lambda pair: (alike[pair], apart[pair], pair))
    for i, j in ranked:
        if used.get(i, 0) < partners and used.get(j, 0) < partners:
            chosen.add((i, j))
            used[i], used[j] = used.get(i, 0) + 1, used.get(j, 0) + 1
    seen = [np.isfinite(one.height_m) for one in images]
    return [
        (a, b)
        for a, b in itertools.combinations(range(len(images)), 2)
        if (min(place[a], place[b]), max(place[a], place[b])) in chosen and (seen[a] & seen[b]).any()
    ]


def match(first: Image, second: Image, at: HeightLevel, settings: HeightSettings, drift_m: float) -> Matched:
    """Match the patches of one image with another.

    drift_m : 1 σ of a pose's error against the mean of its piece; it is no error of the match, and adds to it.
    """
    size = max(round(at.patch_m / at.cell_m), 4)
    corner = _corners(first.height_m.shape, size, max(round(at.stride_m / at.cell_m), 1))
    patch = np.arange(len(corner))
    count = len(corner)
    shift, spread = np.zeros((count, 3)), np.zeros(count)
    shift[:, 2] = _middle_difference(first, second)
    crossed, mean = np.zeros((count, UNKNOWNS, UNKNOWNS)), np.zeros((count, UNKNOWNS, UNKNOWNS))
    used, felt = np.zeros(count, dtype=np.int32), np.zeros((count, MOMENTS))
    step = settings.every if size >= 8 * settings.every else 1
    least = int(settings.covered * (size / step) ** 2)
    match_patches(
        first.height_m, second.height_m, at.cell_m, corner, size, step, settings.iterations, least,
        Matches(shift, crossed, mean, spread, used, felt),
    )  # fmt: skip
    centre = first.corner_m + at.cell_m * (corner[:, ::-1] + 0.5 * (size - 1))
    # The error of a pose is common to all patches across the drive: it does not average out among them.
    across = max(_WIDTH_M / at.stride_m, 1.0)
    floor_m2 = settings.sigma_floor_m**2 + 2.0 * drift_m**2 * across
    independent = np.maximum(_INDEPENDENT / step**2, 1.0)
    upright, level = np.full((count, 1, 3), np.nan), np.full((count, 2, 3), np.nan)
    found = used > 0
    upright[found], level[found] = rows_of(
        crossed[found], mean[found], spread[found] * independent, settings.coherence, floor_m2
    )
    good = np.isfinite(upright).all((1, 2)) & np.isfinite(level).all((1, 2))
    good &= np.hypot(shift[:, 0], shift[:, 1]) <= at.reach_m
    if good.any():
        good &= spread <= 9.0 * np.median(spread[good])
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = felt[:, 1:] / felt[:, :1]
    xy = first.corner_m + at.cell_m * middle[:, :2]
    felt_m = np.concatenate([np.where(np.isfinite(xy), xy, centre), middle[:, 2:]], axis=1)
    return Matched(first, second, patch[good], centre[good], felt_m[good], shift[good], upright[good], level[good])


def _corners(shape: tuple[int, ...], size: int, stride: int) -> npt.NDArray[np.int32]:
    """Return the corners (n, 2), row and column, of all patches of an image."""
    r, c = (np.arange(0, max(edge - size, 0) + 1, stride, dtype=np.int32) for edge in shape)
    return np.stack(np.meshgrid(r, c, indexing="ij"), axis=-1).reshape(-1, 2)


def _middle_difference(first: Image, second: Image) -> float:
    """Return the median of the heights' difference."""
    away = second.height_m[::4, ::4] - first.height_m[::4, ::4]
    away = away[np.isfinite(away)]
    return float(np.median(away)) if away.size else 0.0


def rows_of(
    crossed: Float64, mean: Float64, variance_m2: Float64, coherence: float, floor_m2: float
) -> tuple[Float64, Float64]:
    """Return rows of unit variance with the information of patches.

    The tilts are eliminated. What remains is one row for the height, and along the principal directions of the
    slopes one row each for the horizontal. With signal S common to both images and noise, `mean` holds S and noise,
    `crossed` S alone; a shift d is found where `mean`'s equations vanish, as S d = noise of covariance `mean`.

    Parameters
    ----------
    crossed, mean : (n, 5, 5) from the kernel. variance_m2 : (n,) of an independent height.
    coherence : least share of common slopes. floor_m2 : variance that no patch goes below.

    Returns
    -------
    (n, 1, 3) and (n, 2, 3), 1/m; NaN where a patch has no information, zero rows for directions that are noise.
    """
    n = len(mean)
    upright, level = np.full((n, 1, 3), np.nan), np.full((n, 2, 3), np.nan)
    sound = (np.linalg.eigvalsh(mean[:, 2:, 2:])[:, 0] > 1e-3 * mean[:, 2, 2]) & (variance_m2 > 0)
    if not sound.any():
        return upright, level
    m, c = (_without_tilts(a[sound]) for a in (mean, crossed))
    lean = m[:, 2, :2] / m[:, 2, 2, None]
    sigma = np.sqrt(variance_m2[sound] / m[:, 2, 2] + floor_m2)
    upright[sound, 0] = np.concatenate([lean, np.ones((len(m), 1))], axis=1) / sigma[:, None]
    s = m[:, :2, :2] - m[:, :2, 2, None] * lean[:, None]
    t = c[:, :2, :2] - c[:, :2, 2, None] * lean[:, None]
    values, vectors = np.linalg.eigh(s)
    unit = vectors / np.sqrt(np.maximum(values, 1e-12 * mean[sound, 2, 2, None]))[:, None]
    share, turn = np.linalg.eigh(np.swapaxes(unit, 1, 2) @ t @ unit)
    along = np.swapaxes(s @ unit @ turn, 1, 2) * share[:, :, None]
    length = np.linalg.norm(along, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt(variance_m2[sound, None] / length**2 + floor_m2)
        row = along / (length * spread)[:, :, None]
    row[share < coherence] = 0.0
    level[sound, :, :2], level[sound, :, 2] = row, 0.0
    return upright, level


def _without_tilts(normal: Float64) -> Float64:
    """Eliminate the last two unknowns from normal matrices: (n, 3, 3)."""
    beside = normal[:, :3, 3:]
    return np.asarray(normal[:, :3, :3] - beside @ np.linalg.solve(normal[:, 3:, 3:], np.swapaxes(beside, 1, 2)))


def _shared(matched: list[Matched]) -> list[Matched]:
    """Reduce weights where more pairs than images contain a patch: q pairs of m images give m − 1 independent ties."""
    pairs: dict[int, int] = {}
    images: dict[int, set[int]] = {}
    for one in matched:
        for patch in one.patch.tolist():
            pairs[patch] = pairs.get(patch, 0) + 1
            images.setdefault(patch, set()).update((id(one.first), id(one.second)))
    share = {patch: math.sqrt((len(images[patch]) - 1) / q) for patch, q in pairs.items()}
    out = []
    for one in matched:
        weaker = np.array([min(share[patch], 1.0) for patch in one.patch.tolist()])[:, None, None]
        out.append(
            Matched(
                one.first, one.second, one.patch, one.centre_m, one.felt_m, one.shift_m,
                one.upright * weaker, one.level * weaker,
            )
        )  # fmt: skip
    return out


def _ties(group: Sequence[Matched], level_from_world: Float64) -> list[Ties]:
    """Return the ties of one pair of sensors: heights, shifts in both directions, shifts in one."""
    found: dict[str, list[tuple[Seen, Seen, Float64]]] = {"heights": [], "shifts": [], "shifts one way": []}
    for one in group:
        heights = np.column_stack([one.centre_m, one.first.height_at(one.centre_m)])
        found["heights"].append(_tied(one, heights, one.upright, np.isfinite(heights[:, 2]), level_from_world))
        knows = (one.level != 0.0).any(axis=2)
        both = knows.all(axis=1)
        found["shifts"].append(_tied(one, one.felt_m, one.level, both, level_from_world))
        row = np.where(knows[:, :1, None], one.level[:, :1], one.level[:, 1:])
        found["shifts one way"].append(_tied(one, one.felt_m, row, knows.any(axis=1) & ~both, level_from_world))
    return [
        Ties(f"overlap, {kind}", Seen.joined([a for a, _, _ in parts]), Seen.joined([b for _, b, _ in parts]),
             np.concatenate([w for _, _, w in parts]))
        for kind, parts in found.items()
        if sum(len(w) for _, _, w in parts)
    ]  # fmt: skip


def _tied(
    one: Matched, place_m: Float64, rows: Float64, good: Bool, level_from_world: Float64
) -> tuple[Seen, Seen, Float64]:
    """Return both ends and their rows in world axes, for accepted patches that have a reading near."""
    there = place_m + one.shift_m
    first, second = one.first.pose_at(place_m), one.second.pose_at(there)
    keep = good & (first >= 0) & (second >= 0)
    return (
        one.first.placed.seen(place_m[keep], first[keep]),
        one.second.placed.seen(there[keep], second[keep]),
        rows[keep] @ level_from_world,
    )
