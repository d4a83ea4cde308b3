"""Readings of a drawn road near a place, with turns of their own: what two passes see whose poses are off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from roadscan.adjust.places import PassReadings, Place, Traverse
from roadscan.simulate.surface import texture_field

EASTING_M, NORTHING_M, HEADING_RAD = 512_345.0, 5_012_345.0, 0.3
PLACE = Place(7, EASTING_M, NORTHING_M, HEADING_RAD, 0.5, (Traverse(0, "a", 0, 1), Traverse(1, "a", 0, 1)))
SLOPE_ACROSS, SLOPE_ALONG = 0.025, 0.01

Road = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Height (m) and brightness of the road at coordinates along and across."""


def texture(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    cell_mm = 1000.0
    field = texture_field(1.0, 8.0, 3)
    return map_coordinates(
        field, [(along * cell_mm) % 1024, (across * cell_mm) % 1024], order=1, mode="grid-wrap"
    )  # fmt: skip


def flat(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return SLOPE_ALONG * along + SLOPE_ACROSS * across, np.full(along.shape, 4000.0)


def edge_line(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height, grey = flat(along, across)
    return height, np.where(np.abs(across - 0.1) < 0.06, 20_000.0, grey)


def dash_end(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height, grey = flat(along, across)
    return height, np.where((np.abs(across - 0.1) < 0.06) & (along < 0.12), 20_000.0, grey)


def crack(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height, grey = flat(along, across)
    way = across - 0.05 * np.sin(8.0 * along) + 0.3 * along
    return height + texture(along, across) - 0.006 * np.exp(-0.5 * (way / 0.004) ** 2), grey


def joints(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grooves across the road each 60 mm."""
    height, grey = flat(along, across)
    return height - 0.005 * np.exp(-0.5 * ((np.mod(along, 0.06) - 0.03) / 0.006) ** 2), grey


def bars(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Painted bars across the road each 100 mm."""
    height, grey = flat(along, across)
    return height, np.where(np.mod(along, 0.1) < 0.05, 20_000.0, grey)


def kerb(along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    height, grey = flat(along, across)
    return height + np.where(across > 0.3, 0.12, 0.0), grey


@dataclass(frozen=True)
class Seen:
    """How a pass sees the road."""

    shift_m: tuple[float, float] = (0.0, 0.0)
    """Easting and northing that its poses are off."""
    lift_m: float = 0.0
    noise_m: float = 0.0005
    turned_rad: float = 0.0
    across_m: float = 0.003
    along_m: float = 0.006


def readings(road: Road, run: int, seen: Seen, rng: np.random.Generator) -> PassReadings:
    """Readings of a profiler over ± 0.8 m, one pose a profile."""
    profile = np.arange(-0.8, 0.8, seen.along_m) + rng.uniform(0.0, seen.along_m)
    reading = np.arange(-0.8, 0.8, seen.across_m) + rng.uniform(0.0, seen.across_m)
    along, across = (a.ravel() for a in np.meshgrid(profile, reading, indexing="ij"))
    along = along + across * seen.turned_rad
    height, grey = road(along, across)
    sine, cosine = np.sin(HEADING_RAD), np.cos(HEADING_RAD)
    n, poses = along.size, profile.size
    body = np.tile([EASTING_M, NORTHING_M, 102.0], (poses, 1))
    return PassReadings(
        run, "a",
        EASTING_M + along * sine + across * cosine + seen.shift_m[0],
        NORTHING_M + along * cosine - across * sine + seen.shift_m[1],
        100.0 + height + seen.lift_m + rng.normal(0.0, seen.noise_m, n),
        np.clip(grey + rng.normal(0.0, 600.0, n), 0, 65_535).astype(np.uint16),
        np.repeat(np.arange(poses, dtype=np.int32), reading.size),
        run * 10**12 + np.arange(poses, dtype=np.int64) * 10**6, body, np.tile(np.eye(3), (poses, 1, 1)),
    )  # fmt: skip
