"""The models of spinning lidars: when their lasers fire and where they look. A model is a file of `lidars/`."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.strict import Strict, load_toml

Float64 = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

FOLDER: Final = Path(__file__).parent / "lidars"


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
