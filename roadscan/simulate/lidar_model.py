"""The models of lidars: when their lasers fire, where they look and how they err. A model is a file of `lidars/`."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import Field

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.strict import Strict, load_toml

FOLDER: Final = Path(__file__).parent / "lidars"


class ModelErrors(Strict):
    """How a model errs, for scenes that ask for it (`lidar.errors`); 1 σ."""

    range_m: float = Field(ge=0.0)
    """Noise of a range."""
    angle_deg: float = Field(ge=0.0)
    """How far a beam goes beside its stated direction, on each of two axes."""
    dropout: float = Field(ge=0.0, le=0.5)
    """Share of returns that are lost."""
    clutter: float = Field(ge=0.0, le=0.5)
    """Share of firings that meet a drop or dust before anything else …"""
    clutter_m: float = Field(gt=0.0)
    """… mostly within this distance beyond the shortest range: beyond it lies one in e (m)."""
    stamp_ns: float = Field(ge=0.0)
    """Jitter of the stamps of the cycles that are measured together."""


class Rosette(Strict):
    """Two optics in line: a fast one turns beams and fan about the axis, a slow one sweeps the fan up and down.

    The centre of the fan rises and falls by the first two terms of an even sweep: a (cos φ + cos 3φ / 9).
    """

    turns_per_s: float = Field(gt=0.0)
    """Turns of the fast optics, clockwise seen from above."""
    sweeps_per_s: float = Field(gt=0.0)
    """Sweeps of the slow optics, up and down."""
    lowest_deg: float
    """Lowest elevation of the fan's centre."""
    highest_deg: float
    """Highest one."""
    aside: float
    """Width of the fan where it lies level, as a share of its height where it stands upright."""

    def aimed(self, time_s: Float64, start_deg: float, fan_deg: Float64) -> tuple[Float64, Float64]:
        """Return azimuth (clockwise) and elevation (…, n) in degrees of n beams at times (…, n) since the start.

        fan_deg : (n,) each beam's place in the fan, upwards where it stands upright.
        """
        turned = start_deg + 360.0 * self.turns_per_s * time_s
        phase = 2.0 * np.pi * self.sweeps_per_s * time_s
        half = (self.highest_deg - self.lowest_deg) / 2.0
        centre = self.lowest_deg + half + 0.9 * half * (np.cos(phase) + np.cos(3.0 * phase) / 9.0)
        aside = self.aside * fan_deg * np.sin(np.radians(turned)) / np.cos(np.radians(centre))
        return turned - aside, centre + fan_deg * np.cos(np.radians(turned))


class Figures(Strict):
    """What the maker's papers state of a model; lists go by the laser's number."""

    title: str
    """Maker and model."""
    cycle_ns: int = Field(gt=0)
    """Time from one firing of a laser to its next."""
    cycles: int = Field(gt=0)
    """Firing cycles that are measured together: within them the head's motion is four straight pieces."""
    firing_ns: list[int]
    """Time of each laser's firing past the cycle's start."""
    elevation_deg: list[float]
    """Angle of each beam above the head's equator."""
    azimuth_deg: list[float] = []
    """Angle of each beam ahead of the head's azimuth, clockwise seen from above; none: 0."""
    rise_mm: list[float] = []
    """Height of each beam's origin along the head's axis; none: 0."""
    range_min_m: float
    """Shorter ranges are not measured."""
    range_step_m: float
    """Unit of recorded ranges."""
    divergence_deg: float
    """Full angle of a beam."""
    rosette: Rosette | None = None
    """Where the fan of beams goes, whose angles `elevation_deg` are then; none: the head turns evenly."""
    capture: Literal["velodyne", "ouster", "hesai"] | None = None
    """Whose packets a capture without a bag has; none: only a bag records it."""
    columns: int | None = None
    """Columns of a turn, where the maker counts them: a capture then begins each at its angle."""
    errors: ModelErrors
    """How it errs."""


@dataclass(frozen=True)
class LidarModel:
    """A model with n lasers."""

    figures: Figures
    firing_ns: Int64
    """(n,)"""
    elevation_deg: Float64
    """(n,)"""
    azimuth_deg: Float64
    """(n,)"""
    rise_m: Float64
    """(n,) height of a beam's origin along the sensor's z."""

    @property
    def lasers(self) -> int:
        """Return the number of lasers."""
        return self.firing_ns.size

    @property
    def block_ns(self) -> int:
        """Return the time of the cycles that are measured together: an HDL-32E sends them as a packet."""
        return self.figures.cycles * self.figures.cycle_ns

    @property
    def spacing_deg(self) -> float:
        """Return the mean angle from beam to beam."""
        return float(np.ptp(self.elevation_deg)) / (self.lasers - 1)


def lidar_model_names() -> list[str]:
    """Return the names of all models."""
    return sorted(file.stem for file in FOLDER.glob("*.toml"))


@functools.cache
def lidar_model(name: str) -> LidarModel:
    """Return a model by name."""
    file = FOLDER / f"{name}.toml"
    figures = Figures.parse(load_toml(file), file=file)
    lasers = len(figures.firing_ns)
    none = [0.0] * lasers
    return LidarModel(
        figures,
        np.array(figures.firing_ns, np.int64),
        np.array(figures.elevation_deg),
        np.array(figures.azimuth_deg or none),
        np.array(figures.rise_mm or none) / 1000.0,
    )
