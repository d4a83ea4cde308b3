"""Paint that pictures show: bright shapes between Canny edges (Canny 1986), where the lidar does not contradict."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.bins import sums_around
from roadscan.assets.green.areas import in_raster
from roadscan.assets.green.cells import CELL_M
from roadscan.assets.green.colours import FINE, FINE_M, Ground
from roadscan.assets.kinds.road_marking import PATCH_PIECES, type_and_symbol
from roadscan.assets.paint.brightness import BRIGHT, BrightSums
from roadscan.assets.paint.components import AROUND_M, Component, Contrast, components_of
from roadscan.assets.paint.detection import LINE_PIECES, Patch, covers, line_outlines, sorted_paint, within
from roadscan.assets.paint.stripes import RoadDirection, Stripe
from roadscan.assets.paint.symbols import UNKNOWN
from roadscan.assets.scene import Box
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.extras import cv2

PAINTED: Final = pa.schema([("line", pa.struct(list(LINE_PIECES))), ("patch", pa.struct(list(PATCH_PIECES)))])
"""A row a piece of paint that pictures show: of a line, or of a marking. No returns are counted to it."""
_LEAST: Final = 2
"""Pictures that must show a fine cell."""
_SAME: Final = 0.7
"""Share of the pictures' weight that must call paint bright."""
_SMOOTH: Final = 0.7  # 1 σ of the weights around a fine cell (fine cells).
_DULL: Final = 2.5
"""Contrasts below so many σ of the mosaic's noise are no paint."""
_HALF, _NEAR = 0.5, 7
"""So do those below this share of the greatest contrast in a square of so many fine cells."""
_PLAIN: Final = 0.2
"""Fine cells whose contrast is within this of 0 are bare, and their scatter tells the noise."""
_CUT_OFF: Final = 1.1
"""The noise over that scatter: a normal one of 1 σ of 0.1 has values beyond, without which it seems a tenth smaller."""
_NOISE_M: Final = 4.0
"""Edge of the square around each place whose cells tell (m): wherever a window is cut, the whole square lies in it."""
_LEAST_NOISE: Final = 0.04  # Least 1 σ of a fine cell's contrast.
_CANNY: Final = (2.0, 4.0)
"""Thresholds of edges: steps over two fine cells, in units of the noise."""
_EDGED: Final = 0.6
"""Share of the outline of a shape, within such a square, that edges have to lie along."""
_SIGMAS_M: Final = 0.025
"""1 σ of the place of paint in pictures (m) that is common to all: a mounting off by 0.1° at 8 m, and a clock."""


class Judged(NamedTuple):
    """How the intensity of the lidar rises from the ground around a shape to the whole of it."""

    rise: float
    """As a share of the surroundings' intensity: the less of that against the near ground and against all around."""
    sigma: float

    @property
    def probability(self) -> float:
        """Returns the probability of paint, whose intensity rises; at the edge of a shadow it does not."""
        paint, none = (
            -0.5 * ((self.rise - at) / spread) ** 2 - np.log(spread)
            for at, spread in ((_PAINT_RISE, np.hypot(self.sigma, 0.5 * _PAINT_RISE)), (0.0, np.hypot(self.sigma, 0.1)))
        )
        if self.rise > _PAINT_RISE:
            paint = max(paint, -np.log(np.hypot(self.sigma, 0.5 * _PAINT_RISE)))
        return float(1.0 / (1.0 + np.exp(np.clip(none - paint, -30.0, 30.0))))


_PAINT_RISE: Final = 0.6
"""Usual rise of the intensity on worn paint."""
_PROBABLE: Final = 0.6  # Less probable shapes are left out.
_ALONE_M, _ALONE = 1.5, 0.6
"""Least length of a line (m), and least contrast, that counts where no return tells of it …"""
_ALONE_PROBABILITY: Final = 0.6  # … and its probability.
_BESIDE_M: Final = 0.12  # A line of the lidar this near (m) is the same.
_SHORTEST_M: Final = 0.1  # Shorter parts of a line (m) are left out.
_WITHIN: Final = 0.3
"""What lies by more than this share in larger paint of the lidar is a part of that."""
_MOST: Final = 0.8
"""Where parts that the lidar found cover more than this share, they stay."""
_NEAR_M: Final = 0.6  # Ground this near to a shape (m) is compared with it.
_LEVEL_M: Final = 2.0  # 1 σ of the weights of the ground all around (m).
_FEWEST: Final = 4
"""Cells with returns on a shape, and beside it, that tell its intensity."""


@dataclass(frozen=True, eq=False)
class Window:
    """Cells of the ground in a window: which of a survey's they are, and their rows and columns in it."""

    cell: Int64
    at: tuple[Int64, Int64]
    shape: tuple[int, int]
    ground: Ground
    rows: pa.Table
    """Their rows in the table of the ground, as those of `ground`."""
    corner_m: tuple[float, float]
    known: Known

    @functools.cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        row, column = self.at
        return cKDTree(np.column_stack([(column + 0.5) * CELL_M, (row + 0.5) * CELL_M]))

    def nearest(self, x: Any, y: Any) -> Int64:
        """Returns the cells of the ground nearest to places (n,) of the window (m, from its corner)."""
        return np.asarray(self.cell[self._tree.query(np.column_stack([x, y]))[1]])

    def cells(self, values: Any, fill: float) -> Any:
        """Returns a raster of values (n,) of the ground's cells."""
        out = np.full(self.shape, fill)
        out[self.at] = values[self.cell]
        return out


def contrast_of_pictures(sums: BrightSums, window: Window) -> tuple[Contrast, Bool]:
    """Returns fine cells of a window as if each that two pictures show were a return, and Canny edges among them."""
    weight, total, square, bright, number = (
        in_raster(np.asarray(v[window.cell], np.float64), window.at, window.shape)
        for v in (sums.weight, sums.contrast, sums.square, sums.bright, sums.number)
    )
    known = number >= _LEAST
    some = np.maximum(weight, 1e-9)
    mean = np.where(known, total / some, 0.0)
    spread = np.sqrt(np.maximum(square / some - mean**2, 0.0) / np.maximum(number, 1.0))
    noise = noise_of(mean, known)
    sigma = np.where(known, np.hypot(noise, spread), np.inf)
    smooth = cv2.GaussianBlur(mean, (0, 0), _SMOOTH)
    highest = cv2.dilate(smooth, np.ones((_NEAR, _NEAR), np.uint8))
    dull = (smooth < np.maximum(np.maximum(BRIGHT, _DULL * noise), _HALF * highest)) | (bright / some < _SAME)
    agreed = np.where(dull, np.minimum(smooth, 0.0), smooth)
    row, column = np.nonzero(known)
    height = in_raster(_fine_heights(window), window.at, window.shape)
    box = Box(0.0, 0.0, window.shape[1] * CELL_M, window.shape[0] * CELL_M)
    count = np.arange(row.size)
    x, y = (np.asarray((at + 0.5) * FINE_M, np.float64) for at in (column, row))
    found = Contrast(
        count, x, y, height[row, column], mean[row, column],
        sigma[row, column], count, row * mean.shape[1] + column, box, agreed.astype(np.float32),
        sigma.astype(np.float32),
    )  # fmt: skip
    return found, canny_edges(mean, noise)


def _fine_heights(window: Window) -> Float64:
    steps = window.ground.fine_steps_m(window.cell)[..., 2]
    return np.asarray(window.ground.height_m[window.cell][:, None] + steps)


def _around(values: Float64) -> Float64:
    """Returns sums of values (rows, columns) over the square of 4 m around each fine cell."""
    return sums_around(values, 2 * round(_NOISE_M / FINE_M / 2) + 1)


def noise_of(mean: Float64, known: Bool) -> Float64:
    """Returns 1 σ (rows, columns) of the contrasts of the bare cells around each fine cell of a mosaic."""
    plain = np.where(known & (np.abs(mean) < _PLAIN), mean, np.nan)
    there, first, second = (_around(np.nan_to_num(v)) for v in (np.isfinite(plain) * 1.0, plain, plain**2))
    there = np.maximum(there, 1.0)
    spread = np.sqrt(np.maximum(second / there - (first / there) ** 2, 0.0))
    return np.maximum(_CUT_OFF * spread, _LEAST_NOISE)


def canny_edges(mean: Float64, noise: Float64) -> Bool:
    """Returns edges (rows, columns) of a mosaic of contrasts, whose thresholds follow its noise."""
    smooth = cv2.GaussianBlur(mean.astype(np.float32), (3, 3), 0.7) / noise
    scale = 100.0  # contrasts up to 2 are 50 times the least noise; their slopes, of four times that, fit into 16 bits
    steps = [cv2.Sobel(smooth * scale, cv2.CV_16S, x, y, ksize=3) for x, y in ((1, 0), (0, 1))]
    low, high = (share * 4.0 * scale for share in _CANNY)
    return np.asarray(cv2.Canny(steps[0], steps[1], low, high, L2gradient=True) > 0)


def edged(found: Contrast, component: Component, edges: Bool) -> Component | None:
    """Returns the part of a component around which edges lie along its outline; None without any."""
    whole = edges.shape
    row, column = np.divmod(component.cell, whole[1])
    reach = math.ceil(AROUND_M / FINE_M) + 1
    first = max(int(row.min()) - reach, 0), max(int(column.min()) - reach, 0)
    last = min(int(row.max()) + reach + 1, whole[0]), min(int(column.max()) + reach + 1, whole[1])
    part = np.zeros((last[0] - first[0], last[1] - first[1]), np.uint8)
    part[row - first[0], column - first[1]] = 1
    outline = (cv2.dilate(part, np.ones((3, 3), np.uint8)) > 0) & (part == 0)
    on_edge = outline & edges[first[0] : last[0], first[1] : last[1]]
    share = _around(on_edge * 1.0) / np.maximum(_around(outline * 1.0), 1.0)
    near = np.divmod(found.cell[component.near], whole[1])
    kept, seen = (share[r - first[0], c - first[1]] >= _EDGED for r, c in ((row, column), near))
    return component.part(kept, seen) if kept.any() else None


class LidarLevel:
    """The intensity of the lidar in the cells of a window, over that of unpainted ground around."""

    def __init__(self, window: Window, painted: Bool) -> None:
        self._returns = window.cells(window.rows["returns"].to_numpy().astype(np.float64), 0.0)
        intensity = np.nan_to_num(window.cells(window.ground.intensity, 0.0))
        free = self._returns * (self._share(painted) < 0.05)
        size = (0, 0)
        weight, level = (cv2.GaussianBlur(v, size, _LEVEL_M / CELL_M) for v in (free, free * intensity))
        level = np.maximum(level / np.maximum(weight, 1e-9), 1e-6)
        self._relative = np.where(weight > 1e-6, intensity / level - 1.0, 0.0)
        self._returns = np.where((weight > 1e-6) & (intensity > 0.0), self._returns, 0.0)
        self._painted = self._share(painted)

    @staticmethod
    def _share(mask: Bool) -> Float64:
        rows, columns = (n // FINE for n in mask.shape)
        return np.asarray(mask.reshape(rows, FINE, columns, FINE).mean(axis=(1, 3)))

    def of(self, mask: Bool) -> Judged | None:
        """Returns how the intensity rises on a shape (fine cells); None where too few returns lie on it or beside."""
        share = self._share(mask)
        size = 2 * round(_NEAR_M / CELL_M) + 1
        near = cv2.dilate((share > 0).astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        used = near & (self._returns > 0) & ((share > 0) | (self._painted < 0.02))
        x, y, w = share[used], self._relative[used], np.minimum(self._returns[used], 4.0)
        if np.count_nonzero(x > 0.1) < _FEWEST or np.count_nonzero(x == 0) < _FEWEST:
            return None
        mean_x, mean_y = float(w @ x / w.sum()), float(w @ y / w.sum())
        spread = float(w @ (x - mean_x) ** 2)
        rise = float(w @ ((x - mean_x) * (y - mean_y))) / spread
        base = mean_y - rise * mean_x
        rest = np.hypot(y - base - rise * x, 0.1)
        sigma = float(np.sqrt(np.sum((w * (x - mean_x) * rest) ** 2))) / spread
        return Judged(min(rise, rise + base), sigma)


class CellDirection(RoadDirection):
    """Direction of the road from cells' distances to the drives: they grow across it."""

    def __init__(self, window: Window) -> None:
        away = window.cells(window.ground.drive_m, np.nan)
        up, right = np.gradient(away)
        known = np.isfinite(up) & np.isfinite(right)
        up, right = np.where(known, up, 0.0), np.where(known, right, 0.0)
        double = [cv2.GaussianBlur(v, (0, 0), _LEVEL_M / CELL_M) for v in (right**2 - up**2, 2.0 * right * up)]
        row, column = np.nonzero(known)
        every = (row % 4 == 0) & (column % 4 == 0)
        row, column = row[every], column[every]
        across = 0.5 * np.arctan2(double[1][row, column], double[0][row, column])
        super().__init__(np.column_stack([(column + 0.5) * CELL_M, (row + 0.5) * CELL_M]), across + np.pi / 2)


def pictured_paint(sums: BrightSums, window: Window, box: Box) -> pa.Table:
    """Returns rows of `PAINTED`: paint that pictures show in a box of the window (m, from its corner)."""
    found, edges = contrast_of_pictures(sums, window)
    edges = cv2.dilate(edges.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    bright = [part for one in components_of(found) if (part := edged(found, one, edges)) is not None]
    if not bright:
        return PAINTED.empty_table()
    mask = np.zeros(edges.shape, np.bool_)
    for one in bright:
        mask.ravel()[one.cell] = True
    paint = sorted_paint(found, bright, window.corner_m, CellDirection(window))
    lidar, known = LidarLevel(window, mask), window.known
    weight, level = (in_raster(v[window.cell], window.at, window.shape) for v in (sums.weight, sums.level))
    level = level / np.maximum(weight, 1e-9)
    rows = []
    shapes: list[Stripe | Patch] = [*paint.lines, *paint.patches]
    for shape in shapes:
        outline = shape.outline if isinstance(shape, Stripe) else shape.shape
        probability = _probability(lidar, shape, covered(outline, edges.shape), level)
        if probability >= _PROBABLE:
            parts = known.new_parts(shape) if isinstance(shape, Stripe) else [shape] * known.is_new(shape)
            rows += [row for part in parts for row in _rows(replace(part, probability=probability), window, box)]
    return pa.Table.from_pylist(rows, schema=PAINTED)


def _probability(lidar: LidarLevel, shape: Stripe | Patch, mask: Bool, level: Float64) -> float:
    """Returns the probability of paint; where no return tells, of a long line brighter than the ground driven over."""
    judged = lidar.of(mask)
    if judged is not None:
        return judged.probability
    alone = isinstance(shape, Stripe) and shape.length_m >= _ALONE_M and shape.contrast >= _ALONE
    alone = alone and bool(mask.any()) and float(level[mask].mean()) >= BRIGHT
    return _ALONE_PROBABILITY if alone else 0.0


def covered(outline: shapely.Geometry, shape: tuple[int, int]) -> Bool:
    """Returns the fine cells (rows, columns) of a window whose middles an outline covers (m, from its corner)."""
    west, south, east, north = outline.bounds
    first = max(int(south / FINE_M) - 1, 0), max(int(west / FINE_M) - 1, 0)
    last = min(int(north / FINE_M) + 2, shape[0]), min(int(east / FINE_M) + 2, shape[1])
    mask = np.zeros(shape, np.bool_)
    if first[0] < last[0] and first[1] < last[1]:
        row, column = np.mgrid[first[0] : last[0], first[1] : last[1]]
        mask[first[0] : last[0], first[1] : last[1]] = shapely.contains_xy(
            outline, (column + 0.5) * FINE_M, (row + 0.5) * FINE_M
        )
    return mask


@dataclass(frozen=True)
class Known:
    """Paint that the lidar found in a window (m, from its corner)."""

    lines: shapely.Geometry
    patches: tuple[shapely.Geometry, ...]

    @classmethod
    def of(cls, pieces: Sequence[pa.Table], corner_m: tuple[float, float]) -> Known:
        """Returns that of tables of pieces of lines and of markings."""
        lines: list[shapely.Geometry] = []
        patches: list[shapely.Geometry] = []
        for table in pieces:
            if "shape" in table.column_names:
                patches += shapely.from_wkb(table["shape"].to_numpy(zero_copy_only=False)).tolist()
            else:
                lines += line_outlines(table.to_pylist())

        def moved(shape: shapely.Geometry) -> shapely.Geometry:
            return shapely.transform(shape, lambda xy: xy - np.array(corner_m))

        return cls(moved(shapely.union_all(lines)), tuple(moved(one) for one in patches))

    def near(self, outline: shapely.Geometry) -> list[shapely.Geometry]:
        """Returns the markings that meet an outline."""
        return [one for one in self.patches if shapely.intersects(one, outline)]

    def new_parts(self, stripe: Stripe) -> list[Stripe]:
        """Returns the parts of a line that lie beside none of the lidar; none within a larger marking."""
        outline = stripe.outline
        for one in self.near(outline):
            common = shapely.intersection(one, outline).area
            if not covers([outline], one) and common >= _WITHIN * outline.area:
                return []
        rest = shapely.LineString([stripe.at(stripe.begin_m), stripe.at(stripe.end_m)])
        rest = shapely.difference(rest, self.lines.buffer(_BESIDE_M))
        out = []
        for part in getattr(rest, "geoms", [rest]):
            if part.length >= _SHORTEST_M:
                ends = np.array(part.coords)[[0, -1]] - stripe.middle_m
                begin, end = sorted((ends @ stripe.along).tolist())
                seen = (
                    stripe.begin_seen and begin <= stripe.begin_m + 1e-6,
                    stripe.end_seen and end >= stripe.end_m - 1e-6,
                )
                out.append(replace(stripe, begin_m=begin, end_m=end, begin_seen=seen[0], end_seen=seen[1]))
        return out

    def is_new(self, patch: Patch) -> bool:
        """Returns whether a marking of known shape lies beside those of the lidar, or is a whole of their parts.

        Patches of light asphalt, and lines with a light spot beside them, have no shape that is known.
        """
        if not (patch.in_crosswalk or np.isfinite(patch.road_rad)):
            return False
        kind, shows = type_and_symbol(patch.shape, patch.shape, patch.road_rad)
        if not (patch.in_crosswalk or kind in {"stop_bar", "arrow"} or shows not in {None, UNKNOWN}):
            return False
        near = self.near(patch.shape)
        parts = [one for one in near if covers([patch.shape], one)]
        whole = shapely.union_all([one for one in near if one not in parts])
        if shapely.union_all(parts).area >= _MOST * patch.shape.area:
            return False
        taken = shapely.union_all([whole, self.lines]).buffer(FINE_M)
        return bool(shapely.intersection(taken, patch.shape).area < _WITHIN * patch.shape.area)


def _rows(shape: Stripe | Patch, window: Window, box: Box) -> list[dict[str, Any]]:
    """Returns the row of a shape's part in a box."""
    east, north = window.corner_m
    if isinstance(shape, Stripe):
        span = within(shape, box)
        if span is None:
            return []
        ends = [shape.at(at) for at in span]
        x, y = (np.array([e[k] for e in ends]) for k in (0, 1))
        seen = {"begin_seen": shape.begin_seen and span[0] == shape.begin_m,
                "end_seen": shape.end_seen and span[1] == shape.end_m}  # fmt: skip
        near = _near(window, (x[0] + x[1]) / 2, (y[0] + y[1]) / 2)
        height = _height(window, x, y)
        line = {
            f"{name}_{axis}_m": float(values[k] + corner)
            for k, name in enumerate(("begin", "end"))
            for axis, values, corner in (("x", x, east), ("y", y, north), ("height", height, 0.0))
        }
        line |= seen | near | {"width_m": shape.width_m, "contrast": shape.contrast,
                               "sigma_across_m": float(np.hypot(shape.sigma_across_m, _SIGMAS_M)),
                               "sigma_height_m": 0.05, "probability": shape.probability}  # fmt: skip
        return [{"line": line, "patch": None}]
    outline = shapely.intersection(shape.shape, shapely.box(box.x_min_m, box.y_min_m, box.x_max_m, box.y_max_m))
    if outline.area <= 0.0:
        return []
    middle = outline.centroid
    step = CELL_M * np.array([0.0, 1.0, -1.0, 0.0, 0.0]), CELL_M * np.array([0.0, 0.0, 0.0, 1.0, -1.0])
    heights = _height(window, middle.x + step[0], middle.y + step[1])
    patch = {
        "shape": shapely.to_wkb(shapely.transform(outline, lambda xy: xy + np.array([east, north]))),
        "in_crosswalk": shape.in_crosswalk, "road_rad": shape.road_rad, "height_m": float(heights[0]),
        "slope_east": float(heights[1] - heights[2]) / (2 * CELL_M),
        "slope_north": float(heights[3] - heights[4]) / (2 * CELL_M), "contrast": shape.contrast,
        "sigma_height_m": 0.05, "probability": shape.probability, **_near(window, middle.x, middle.y),
    }  # fmt: skip
    return [{"line": None, "patch": patch}]


def _height(window: Window, x: Float64, y: Float64) -> Float64:
    return np.asarray(window.ground.height_m[window.nearest(x, y)])


def _near(window: Window, x: float, y: float) -> dict[str, Any]:
    """Returns the passes and epochs of the cell nearest to a place that returns show."""
    cell = int(window.nearest([x], [y])[0])
    row = window.rows.select(["passes", "first_epoch_gps_ns", "last_epoch_gps_ns"]).slice(cell, 1).to_pylist()[0]
    return {"returns": 0, **row}
