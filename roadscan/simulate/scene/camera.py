"""The cameras of a scene's rig: pictures, lens, shutter, exposure, faults, and what the rig file has wrong of them."""

from __future__ import annotations

from typing import Final, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict, pattern_in_words
from roadscan.simulate.scene.rig import ClockError, Mount


class LensError(Strict):
    """How far the interior orientation of the rig file lies from the true one: stated = true + error."""

    focal_px: float = Field(default=0.0, ge=-500.0, le=500.0)
    """Error of the focal length (pixels)."""
    principal_px: tuple[float, float] = (0.0, 0.0)
    """Error of the principal point (pixels)."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Errors of k1, k2, p1, p2, k3."""


class Exposure(Strict):
    """Exposure that changes from picture to picture: grey values are multiplied by a gain.

    Its logarithm is the sum of a random walk and of steps, returns to 0 by 4 % from picture to picture, and stays
    within ± 0.6.
    """

    walk: float = Field(default=0.02, ge=0.0, le=0.5)
    """Step of the random walk from picture to picture (logarithm, 1 σ)."""
    step: float = Field(default=0.0, ge=0.0, le=0.9)
    """Size of a sudden step up or down (logarithm), as behind a bridge …"""
    steps_per_100: float = Field(default=2.0, ge=0.0, le=100.0)
    """… and how many of them a hundred pictures have, on average."""


class PictureFaults(Strict):
    """Pictures that went wrong, by their numbers in the pass, from 0."""

    black: list[int] = []
    """Pictures without light: the noise alone."""
    doubled: list[int] = []
    """Pictures whose file holds the picture before once more, under a separate stamp."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if 0 in self.doubled:
            raise ValueError("doubled names picture 0, which has none before it")
        return self


class Camera(Strict):
    """A camera: pictures of a pinhole with or without distortion (Brown–Conrady, as OpenCV has it), or of 360°."""

    on: bool = False
    """Whether the rig carries it."""
    every_m: float = Field(default=5.0, gt=0.1)
    """Distance driven from picture to picture (m)."""
    model: Literal["perspective", "equirectangular"] = "perspective"
    """`equirectangular` for pictures of 360°: their columns and rows are even steps of longitude and latitude over the
    whole sphere, so that focal length, principal point and distortion say nothing."""
    width_px: int = Field(default=960, ge=64, le=8192)
    """Width of a picture."""
    height_px: int = Field(default=600, ge=64, le=8192)
    """Height of a picture."""
    focal_px: float = Field(default=820.0, gt=10.0)
    """Focal length (pixels)."""
    principal_px: tuple[float, float] | None = None
    """Principal point, from the centre of the upper left pixel; the picture's middle where left out."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3."""
    range_max_m: float = Field(default=80.0, gt=5.0, le=500.0)
    """What lies farther away is sky (m)."""
    colour: bool = False
    """Whether its pictures have colours; grey where not."""
    noise: float = Field(default=2.0, ge=0.0, le=50.0)
    """Noise of the pixels' values."""
    jpeg_quality: int = Field(default=90, ge=10, le=100)
    """Quality of the pictures' compression."""
    blur_px: float = Field(default=0.0, ge=0.0, le=5.0)
    """Blur of the lens, a Gaussian's σ (pixels); 0: none, and edges along rows or columns are jagged."""
    vignetting: float = Field(default=0.0, ge=0.0, le=0.9)
    """Share of the light that the picture's corners lose; it grows with the square of the distance from the middle."""
    exposure: Exposure | None = None
    """Exposure that changes; constant where left out."""
    line_time_us: float = Field(default=0.0, ge=0.0, le=500.0)
    """Rolling shutter: time from one row's exposure to that of the row below (µs); 0: all rows at once."""
    stamped_row: Literal["first", "middle", "last"] = "first"
    """Row whose exposure the stamp, and the true pose, are for, with a rolling shutter."""
    faults: PictureFaults = PictureFaults()
    """Pictures that went wrong."""
    lens_error: LensError = LensError()
    """What the rig file has wrong of the lens."""
    mount: Mount = Mount(lever_arm_body_m=(0.9, -0.25, -1.15), roll_deg=0.3, pitch_deg=-12.0, heading_deg=1.5)
    """Mounting (axes frd of the sensor frame: x forward along the optical axis, y right, z down)."""
    clock: ClockError = ClockError()
    """Clock of its stamps; Unix UTC by default."""

    @property
    def stamped_row_px(self) -> float:
        """Row whose exposure the stamp is for (pixels, from the middle of the upper row)."""
        return {"first": 0.0, "middle": (self.height_px - 1) / 2, "last": self.height_px - 1.0}[self.stamped_row]

    def stated(self) -> Self:
        """Return the camera with the lens that the rig file states."""
        wrong = self.lens_error
        if wrong == LensError() or self.model == "equirectangular":
            return self
        principal = self.principal_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)
        return self.model_copy(
            update={
                "focal_px": self.focal_px + wrong.focal_px,
                "principal_px": tuple(a + b for a, b in zip(principal, wrong.principal_px, strict=True)),
                "distortion": tuple(a + b for a, b in zip(self.distortion, wrong.distortion, strict=True)),
            }
        )


_FURTHER: Final = pattern_in_words(
    r"^camera_[a-z0-9_]{1,24}$", "camera_ and 1 to 24 small letters (a–z), digits or '_', such as camera_left"
)
"""Names of further cameras."""


class FurtherCamera(Camera):
    """A further camera of the rig, with its mounting, lens and clock."""

    on: bool = True
    """Whether the rig carries it."""
    name: str = Field(pattern=_FURTHER)
    """Its name in the rig file, and that of its folder: camera_ and what tells it apart."""


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
