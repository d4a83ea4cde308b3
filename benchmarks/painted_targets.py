"""Readings of painted targets without a formula of the fit: shapes are masks, wear is noise held against a level.

Two sources of a road's intensity: the simulator's surface (`SimulatedRoad`), and a picture painted by OpenCV at
1 mm (`painted_sample`), both read at the places of a profiler's readings by a drive in any direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates

from roadscan.adjust.targets.shapes import Disc, ExpectedTarget, Shape, TargetReadings
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

HALF_M = 1.05
"""Half of the edge of the square that is read."""
PIXEL_M = 0.001
ASPHALT, PAINT, BLACK = 70.0, 190.0, 15.0
TARGET = Disc(0.30, 0.06)
STATION_M, OFFSET_M = 50.0, 2.6
"""Where the simulated target lies."""
ORIGIN_M = (512_345.678, 5_403_210.987)
"""Map coordinates of a painted picture's middle."""


@dataclass(frozen=True)
class Reading:
    """How readings lie and what they suffer."""

    across_m: float = 0.005
    """From reading to reading of a profile."""
    along_m: float = 0.010
    """From profile to profile."""
    noise: float = 4.0
    """1 σ of single intensities."""
    height_noise_m: float = 0.0005
    footprint_m: float = 0.0
    """Standard deviation of a reading's spot."""
    stated_sigma_m: float = 0.05
    """By which the stated place misses the true one, each axis."""


READING = Reading()


@dataclass(frozen=True)
class Wear:
    """Worn paint."""

    contrast: float = 1.0
    """Share of the contrast that is left."""
    missing: float = 0.0
    """Share of the paint that is gone, in patches."""
    patch_m: float = 0.02
    """Size of the patches (standard deviation of what is cut at a level)."""


NEW, WORN = Wear(), Wear(0.5, 0.3)


@dataclass(frozen=True)
class Sample:
    """Readings of one target, and the truth."""

    readings: TargetReadings
    expected: ExpectedTarget
    true_m: Float64
    """(3,) easting, northing, height of its middle."""


@dataclass(frozen=True)
class Sight:
    """Places of readings about a middle, east and north (m), and a stream of chance."""

    place_m: Float64
    rng: np.random.Generator
    heading_rad: float

    @classmethod
    def of(cls, rng: np.random.Generator, reading: Reading, half_m: float = HALF_M) -> Sight:
        """Profiles of a drive in a random direction, their spacing varying by some per cent."""
        heading = float(rng.uniform(0.0, 2 * math.pi))
        along = np.arange(-half_m, half_m, reading.along_m)
        along = along + rng.uniform(0.0, reading.along_m) + rng.normal(0.0, 0.05 * reading.along_m, along.size)
        across = np.arange(-half_m, half_m, reading.across_m) + rng.uniform(0.0, reading.across_m)
        s, y = np.meshgrid(along, across, indexing="ij")
        y = y + rng.uniform(-0.002, 0.002, (along.size, 1))  # the vehicle sways
        sin, cos = math.sin(heading), math.cos(heading)
        return cls(np.stack([s * sin + y * cos, s * cos - y * sin], axis=-1).reshape(-1, 2), rng, heading)


def patches_gone(rng: np.random.Generator, wear: Wear, size: int, pixel_m: float) -> Float32:
    """Share of the paint that is left (size, size): 0 in patches, as a smooth random field lies below a level."""
    rough = gaussian_filter(rng.standard_normal((size, size), dtype=np.float32), wear.patch_m / pixel_m / 2)
    left: Float32 = (rough >= np.quantile(rough, wear.missing)).astype(np.float32)
    return left


def sampled(image: Float32, place_m: Float64, pixel_m: float, order: int = 1) -> Float64:
    """Values of an image at places about its middle."""
    middle = (image.shape[0] - 1) / 2
    at = [middle - place_m[:, 1] / pixel_m, middle + place_m[:, 0] / pixel_m]
    values: Float64 = map_coordinates(image, at, order=order, mode="nearest", output=np.float64)
    return values


def _sample(sight: Sight, reading: Reading, shape: Shape, true_m: Float64, seen: tuple[Float64, Float64]) -> Sample:
    """Readings with their noise, as whole digital numbers; the stated place misses the true one."""
    rng, (value, height) = sight.rng, seen
    value = np.clip(np.rint(value + rng.normal(0.0, reading.noise, value.size)), 0, 255).astype(np.uint16)
    height = height + rng.normal(0.0, reading.height_noise_m, height.size)
    place = sight.place_m + true_m[:2]
    sigma = reading.stated_sigma_m
    stated = true_m[:2] + rng.normal(0.0, sigma, 2)
    expected = ExpectedTarget("T", float(stated[0]), float(stated[1]), float(true_m[2]), sigma, shape)
    readings = TargetReadings(place[:, 0], place[:, 1], height, value, 0.01)
    return Sample(readings, expected, true_m)


@dataclass(frozen=True)
class SimulatedRoad:
    """The simulator's road with one target, and without it."""

    with_target: Surface
    without: Surface
    shape: Disc = field(default=TARGET)

    @classmethod
    def of(cls, shape: Disc = TARGET, **road: object) -> SimulatedRoad:
        """A textured, rutted, stained road."""
        features: dict[str, object] = {
            "texture": {"mpd_mm": 0.9, "contrast": 6.0},
            "roughness": {"iso_class": "B"},
            "ruts": [{"offset_m": 0.9}, {"offset_m": 2.6}],
            **road,
        }
        target = {
            "station_m": STATION_M, "offset_m": OFFSET_M,
            "diameter_m": shape.diameter_m, "centre_m": shape.centre_m,
        }  # fmt: skip
        bare = Surface(Scene(seed=11).changed(road=features))
        return cls(Surface(Scene(seed=11).changed(road={**features, "targets": [target]})), bare, shape)

    def sample(self, rng: np.random.Generator, reading: Reading = READING, wear: Wear = NEW) -> Sample:
        """Readings of the target, worn between the road with it and the road without it."""
        easting, northing, _ = self.with_target.place(STATION_M, OFFSET_M)
        height = self.with_target.height_m(easting, northing, texture=False)
        true = np.array([float(easting), float(northing), float(height)])
        sight = Sight.of(rng, reading)
        at = (sight.place_m + true[:2]).T
        painted, bare = self.with_target.intensity(*at), self.without.intensity(*at)
        gone = patches_gone(rng, wear, 512, 2 * HALF_M / 512)
        left = wear.contrast * sampled(gone, sight.place_m, 2 * HALF_M / 512, order=0)
        seen = bare + left * (painted - bare), self.with_target.height_m(*at)
        return _sample(sight, reading, self.shape, true, seen)

    def empty(
        self, rng: np.random.Generator, reading: Reading = READING, *, offset_m: float, station_m: float
    ) -> Sample:
        """Readings of another place of the road, where the survey states the target wrongly."""
        easting, northing, _ = self.without.place(station_m, offset_m)
        true = np.array([float(easting), float(northing), float(self.without.height_m(easting, northing))])
        sight = Sight.of(rng, reading)
        at = (sight.place_m + true[:2]).T
        return _sample(sight, reading, self.shape, true, (self.without.intensity(*at), self.without.height_m(*at)))


def furnished_road() -> SimulatedRoad:
    """A road with all that may be taken for a target, a thing each 5 m, and no target at those places."""
    return SimulatedRoad.of(
        stains=[
            {"station_m": 5.0, "offset_m": 1.0, "length_m": 0.3, "width_m": 0.3},
            {"station_m": 5.0, "offset_m": -1.0, "length_m": 0.32, "width_m": 0.28, "shade": 120.0},
        ],
        tyre_marks=[
            {"points_m": [[9.0, 0.8], [11.0, 1.2]]},
            {"points_m": [[14.0, 1.0], [15.0, 1.05], [16.0, 0.9]], "width_m": 0.06, "shade": 15.0},
            {"points_m": [[14.0, -1.0], [15.0, -1.1], [16.0, -0.9]], "width_m": 0.06, "shade": 160.0},
            {"points_m": [[15.0, -2.0], [15.0, -0.2]], "width_m": 0.06, "shade": 160.0},
        ],
        markings=[
            {"offset_m": 3.3, "width_m": 0.12},
            {"offset_m": 0.0, "width_m": 0.15, "dash_m": 0.3, "gap_m": 0.7},
            {"offset_m": -3.2, "width_m": 0.3, "dash_m": 0.3, "gap_m": 0.7},
        ],
        patches=[
            {"station_m": 20.0, "offset_m": 1.5, "shape": "circle", "length_m": 0.6, "shade": 150.0},
            {"station_m": 20.0, "offset_m": -1.5, "shape": "circle", "length_m": 0.24, "shade": 180.0},
            {"station_m": 25.0, "offset_m": 1.5, "shape": "circle", "length_m": 0.37, "shade": 180.0},
            {"station_m": 25.0, "offset_m": -1.5, "length_m": 0.3, "width_m": 0.3, "shade": 180.0},
        ],
        stop_bars=[{"station_m": 30.0, "from_m": -2.5, "to_m": 2.5, "width_m": 0.3}],
        crosswalks=[{"station_m": 37.0, "from_m": -3.0, "to_m": 3.0, "stripe_m": 0.3, "gap_m": 0.3}],
    )


def other_places() -> list[tuple[str, float, float]]:
    """What lies where on that road: name, station and offset (m)."""
    return [
        ("stain", 5.0, 1.0), ("bright stain", 5.0, -1.0), ("tyre mark", 10.0, 1.0), ("dark checked_json", 15.0, 1.0),
        ("bright seals", 15.0, -1.0), ("line", 12.0, 3.3), ("dashes", 12.3, 0.0), ("square dashes", 12.3, -3.2),
        ("large disc", 20.0, 1.5), ("small disc", 20.0, -1.5), ("larger disc", 25.0, 1.5), ("square", 25.0, -1.5),
        ("stop bar", 30.0, 1.0), ("crossing", 37.0, 1.0), ("bare asphalt", 7.0, 1.8),
    ]  # fmt: skip


Painter = Callable[[Float32, np.random.Generator], None]
"""Draws things on a road's picture (pixels of `PIXEL_M`)."""


def paint_shape(shape: Shape, turn_rad: float, at_m: tuple[float, float] = (0.0, 0.0)) -> tuple[Float32, Float32]:
    """Masks (0 to 1) of white and black paint, drawn by OpenCV as polygons and circles with 8 bits of sub-pixels."""
    size = round(2 * HALF_M / PIXEL_M)
    white, black = np.zeros((size, size), np.uint8), np.zeros((size, size), np.uint8)
    middle = np.array([(size - 1) / 2 + at_m[0] / PIXEL_M, (size - 1) / 2 - at_m[1] / PIXEL_M])
    fine = 256.0

    def whole(points: Float64) -> npt.NDArray[np.int32]:
        return np.rint(points * fine).astype(np.int32)

    if isinstance(shape, Disc):
        centre = tuple(int(c) for c in whole(middle))
        cv2.circle(white, centre, int(shape.half_m / PIXEL_M * fine), 255, -1, cv2.LINE_AA, 8)
        if shape.centre_m:
            cv2.circle(black, centre, int(shape.centre_m / 2 / PIXEL_M * fine), 255, -1, cv2.LINE_AA, 8)
    else:
        edge = shape.half_m / PIXEL_M
        u = edge * np.array([math.cos(turn_rad), -math.sin(turn_rad)])
        v = edge * np.array([-math.sin(turn_rad), -math.cos(turn_rad)])
        for mask, signs in ((white, ((1, 1), (-1, -1))), (black, ((1, -1), (-1, 1)))):
            if mask is black and shape.quadrants == 2:
                continue
            for a, b in signs:
                corners = np.array([middle, middle + a * u, middle + a * u + b * v, middle + b * v])
                cv2.fillPoly(mask, [whole(corners)], 255, cv2.LINE_AA, 8)
    return (white / np.float32(255)).astype(np.float32), (black / np.float32(255)).astype(np.float32)


def asphalt(rng: np.random.Generator) -> Float32:
    """A road's grey: stones of 8 mm, and broad stains."""
    size = round(2 * HALF_M / PIXEL_M)
    coarse = rng.standard_normal((size // 8, size // 8), dtype=np.float32)
    stones = gaussian_filter(coarse, 0.8)
    broad = gaussian_filter(rng.standard_normal((size // 8, size // 8), dtype=np.float32), 40.0)
    grey = 6.0 * stones / stones.std() + 5.0 * broad / broad.std() + ASPHALT
    return np.asarray(cv2.resize(grey.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC), np.float32)


def painted_sample(
    rng: np.random.Generator, shape: Shape, reading: Reading = READING, wear: Wear = NEW, other: Painter | None = None
) -> Sample:
    """Readings of a target painted at a random turn on a random road, with other things on it."""
    road = asphalt(rng)
    if other is not None:
        other(road, rng)
    white, black = paint_shape(shape, float(rng.uniform(0.0, math.pi)))
    left = np.ones_like(road)
    if wear.missing:
        small = patches_gone(rng, wear, road.shape[0] // 8, 8 * PIXEL_M)
        left = cv2.resize(small, road.shape, interpolation=cv2.INTER_LINEAR)
    left *= np.float32(wear.contrast)
    road += left * (white - black) * (white >= black) * (np.float32(PAINT) - road)
    road += left * black * (np.float32(BLACK) - road)
    return read_picture(road, rng, shape, reading)


def read_picture(road: Float32, rng: np.random.Generator, shape: Shape, reading: Reading = READING) -> Sample:
    """Readings of a picture whose middle is where the survey has the target; the road rises and is crowned."""
    if reading.footprint_m:
        road = gaussian_filter(road, reading.footprint_m / PIXEL_M)
    sight = Sight.of(rng, reading, HALF_M - 0.1)
    rise, bend = rng.normal(0.0, 0.02, 2), 0.002
    height = 312.4 + sight.place_m @ rise - bend * sight.place_m[:, 0] ** 2
    height = height + 0.0005 * rng.standard_normal(height.size)
    true = np.array([*ORIGIN_M, 312.4])
    return _sample(sight, reading, shape, true, (sampled(road, sight.place_m, PIXEL_M), height))
