"""Settings of assets (section ``[assets]`` of the survey file)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Final, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict
from roadscan.core.survey import SurveySection
from roadscan.pictures.views import PictureRule

_LARGEST_HOLE_M: Final = 10.0
"""Across holes that reach farther from seen ground (m), heights depend little on ground that lies farther away."""


class GroundSettings(Strict):
    """How returns on bare earth are told from all others."""

    method: Literal["morphological", "planes"] = "morphological"
    """The filter: "morphological" opens the surface of lowest returns with growing windows; "planes" fits planes to
    the returns again and again (RANSAC), each to what the planes before left over."""
    cell_m: float = Field(default=0.25, ge=0.05, le=2.0)
    """Edge of a cell of the bare-earth raster (m)."""
    steepest: float = Field(default=0.15, gt=0.0, le=1.0)
    """Slope of the terrain above which a step over a window's width counts as an object's (m/m)."""
    largest_object_m: float = Field(default=18.0, gt=0.0, le=100.0)
    """Greatest half-width of an object that stands on the ground (m)."""
    reach_m: float = Field(default=10.0, ge=0.0, le=1000.0)
    """How far from ground that was seen its height is interpolated; beyond, it is not known (m)."""

    @property
    def depends_on_m(self) -> float:
        """Returns how far away a return can change the ground at a place (m).

        An opening looks at disks that hold the place, and at all of each: twice the half-width of the largest object.
        The height of a hole depends on ground that was seen around it.
        """
        return 2.0 * self.largest_object_m + min(self.reach_m, _LARGEST_HOLE_M)


class AssetPicturesSettings(Strict):
    """Which pictures show assets, and what is looked for in them."""

    on: bool = True
    """Name the pictures that show each asset best, and look at them. Without cameras nothing is named."""
    cameras: list[str] = []
    """Cameras of the rig whose pictures count; all of them where empty."""
    reach_m: float = Field(default=40.0, gt=1.0, le=200.0)
    """Farthest distance from a camera to an asset (m)."""
    most: int = Field(default=3, ge=1, le=10)
    """How many pictures are named for an asset, at most."""
    cut_outs: bool = True
    """Keep the part of each of these pictures that shows a sign, as a JPEG file."""
    margin: float = Field(default=0.25, ge=0.0, le=2.0)
    """How far a cut-out reaches beyond the sign on each side, as a share of its size."""
    text: bool = False
    """Read the text on signs; needs the extra `ocr` (pip install "roadscan[ocr]")."""
    sign_types: Literal["both", "vienna", "mutcd", "off"] = "both"
    """Tell the types of signs with the recogniser that comes with roadscan: of the set that the country has, of both
    sets, or not at all. docs/assets.md lists the types."""
    recogniser: Path | None = None
    """ONNX model of your own that tells the type of a sign from its cut-out; needs the extra `onnx`. It goes before the
    recogniser that comes with roadscan. docs/assets.md says what it gets and gives."""


class GroundSectionsConfig(Strict):
    """Cross-sections of bare earth."""

    spacing_m: float = Field(default=10.0, ge=0.5, le=1000.0)
    """Distance between cross-sections along the road (m); they stand at its multiples."""
    half_width_m: float = Field(default=15.0, ge=1.0, le=100.0)
    """How far they reach to both sides of the reference line (m)."""
    step_m: float = Field(default=0.25, ge=0.05, le=5.0)
    """Distance between the heights of a cross-section (m)."""


class AssetsConfig(SurveySection):
    """What stands on, beside and over the road. Without this section no asset is sought."""

    table: ClassVar[str] = "assets"
    meaning: ClassVar[str] = "Assets on, beside and over the road; left out, none are sought. Needs the extra `opencv`."
    may_be_left_out: ClassVar[bool] = True

    kinds: list[str] | None = None
    """Kinds of assets to find; those that they need are found with them. Left out, all kinds."""
    sensors: list[str] | None = None
    """Sensors whose returns are looked at. Left out, all lidars, line scanners with a turning mirror and clouds;
    profilers that measure by triangulation see the pavement alone."""
    tile_m: float = Field(default=80.0, ge=5.0, le=500.0)
    """Edge of the squares that are searched one by one (m); the next multiple of `tiles.size_m` is taken. Changes no
    result but where lines are cut. A search looks beyond its square as far as the ground filter and the kinds need."""
    max_block_returns: int = Field(default=6_000_000, ge=1)
    """Squares that are expected to hold more returns together are not searched by one task; a worker needs about
    400 MB, and 400 bytes a return of its largest scene. Changes no result."""
    max_scene_returns: int = Field(default=6_000_000, ge=0)
    """Up to four by four squares that are expected to hold no more returns together are searched in one scene, which
    takes less time than one a square; 0: each in its own. Changes no result but what lies where scenes end."""
    intensity: Literal["calibrated", "raw"] = "calibrated"
    """Intensities that kinds look at: calibrated by gains for each laser, range and angle of incidence, which some
    squares tell (table `intensity_gains`), or as recorded. Classified points always hold recorded ones."""
    ground: GroundSettings = GroundSettings()
    """Bare earth."""
    pictures: AssetPicturesSettings = AssetPicturesSettings()
    """Pictures of assets."""
    options: dict[str, dict[str, Any]] = {}
    """Settings by kind, for example { pole = { least_height_m = 1.5 } }."""
    exports: list[Literal["gpkg", "geojson", "dxf"]] = ["gpkg", "geojson", "dxf"]
    """Files beside the GeoParquet tables: one GeoPackage with a layer a kind, a GeoJSON file a kind, one DXF drawing
    with a layer a kind."""
    classified: bool = True
    """Write the returns of each square with their classes (LAZ)."""
    bare_earth: bool = True
    """Write the bare earth of each square as a GeoTIFF."""
    cross_sections: GroundSectionsConfig | None = None
    """Cross-sections of bare earth by station (CSV, DXF); left out, none."""

    @model_validator(mode="before")
    @classmethod
    def _no_halo(cls, stated: Any) -> Any:
        if isinstance(stated, dict) and "halo_m" in stated:
            raise ValueError(
                "halo_m: how far a search looks beyond its square follows from the ground filter and the kinds; "
                "remove this line"
            )
        return stated

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.cross_sections is not None and not self.bare_earth:
            raise ValueError("cross_sections are made of bare earth: bare_earth = false leaves them without it")
        return self


_ANY_ANGLE_DEG: Final = -90.0  # Least angle below the horizon: any (degrees).
_BORDER_PX: Final = 1  # Border of a picture that is not used (pixels).


def picture_rule(settings: AssetPicturesSettings) -> PictureRule:
    """Returns the rule: pictures of the cameras that are asked for, within reach, at any angle."""
    return PictureRule(tuple(settings.cameras), settings.reach_m, _ANY_ANGLE_DEG, _BORDER_PX)
