"""The random brightness of a scene's surfaces in pictures, so that their features can be matched."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict


class Albedo(Strict):
    """Random brightness of a surface in pictures: noise of several octaves, fixed to the surface in space.

    An octave that is finer than a pixel fades out, as in a picture. Lidars and profilers do not see it.
    """

    contrast: float = Field(default=0.12, ge=0.0, le=0.6)
    """Standard deviation of the brightness, as a share of its mean, over all octaves."""
    finest_m: float = Field(default=0.01, ge=0.002, le=1.0)
    """Wavelength of the finest octave (m)."""
    coarsest_m: float = Field(default=1.0, ge=0.01, le=20.0)
    """No octave is longer than this (m); each is twice as long as the one before."""
    growth: float = Field(default=1.0, ge=0.5, le=2.0)
    """Contrast of an octave over that of the next finer one."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.coarsest_m < self.finest_m:
            raise ValueError(f"coarsest_m {self.coarsest_m:g} is finer than finest_m {self.finest_m:g}")
        return self


class RoadsideAlbedo(Albedo):
    """Random brightness in pictures of all that stands and moves; moving things take theirs along."""

    leaves: float = Field(default=0.35, ge=0.0, le=0.6)
    """`contrast` of trees, plants and hedges."""
    smooth: float = Field(default=0.03, ge=0.0, le=0.6)
    """`contrast` of vehicles, signs, posts and lamps."""
    bricks: float = Field(default=0.12, ge=0.0, le=0.6)
    """Contrast of the bricks of façades and walls, which are 0.25 m by 0.075 m; 0: plastered."""


class SurfaceAlbedo(Strict):
    """Random brightness of surfaces in pictures; what is left out is even."""

    road: Albedo | None = None
    """Of lanes and shoulders; their paint has 0.4 of its contrast."""
    verge: Albedo | None = None
    """Of the verge and of kerbs."""
    beside: RoadsideAlbedo | None = None
    """Of what stands and moves."""
