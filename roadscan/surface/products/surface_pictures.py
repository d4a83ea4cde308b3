"""``surface_pictures``: a tile's surface before and after smoothing, side by side in the same light."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Final, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.core.strict import Strict
from roadscan.store.codecs import SOFTWARE
from roadscan.store.codecs.grey_picture import check_picture, write_png
from roadscan.surface.tile import EMPTY, SurfaceTile
from roadscan.tiles.product import ProductContext, SurfaceProduct
from roadscan.tiles.products.hillshade import shade

Grey = npt.NDArray[np.uint8]

_GAP_PX: Final = 16  # Gap between the halves (pixels).


class SurfacePicturesOptions(Strict):
    """Settings of `surface_pictures`."""

    azimuth_deg: float = Field(default=315.0, ge=0, lt=360)
    """Where the light comes from, clockwise from map north (degrees)."""
    altitude_deg: float = Field(default=45.0, gt=0, le=90)
    """Height of the light above the horizon (degrees)."""
    z_factor: float = Field(default=3.0, gt=0)
    """Exaggeration: heights are multiplied by this (ruts and cracks are flat things)."""


class SurfacePictures(SurfaceProduct):
    """A PNG a tile: on the left the shaded heights before smoothing, on the right those after it.

    As figures 3, 6, 7 and 8 of Yu et al. (2007): one light (Horn 1981), north up, over the part of the tile that holds
    heights. A pixel is a cell; where its edges differ, it is repeated along the longer one. 0, transparent, is empty,
    and so is the gap between the halves.
    """

    name: ClassVar[str] = "surface_pictures"
    title: ClassVar[str] = "shaded surface of a tile before and after smoothing, side by side (PNG)"
    suffix: ClassVar[str] = ".png"
    version: ClassVar[int] = 2
    default: ClassVar[bool] = False
    options: ClassVar[type[Strict]] = SurfacePicturesOptions

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the picture."""
        light = cast(SurfacePicturesOptions, options)
        halves = [_shaded(heights, surface, light) for heights in (surface.raw_m, surface.height_m)]
        gap = np.zeros((halves[0].shape[0], _GAP_PX), np.uint8)
        about = {"Software": SOFTWARE, "Title": f"{self.name} {context.survey_id} {surface.tile}: before | after"}
        write_png(path, np.concatenate([halves[0], gap, halves[1]], axis=1), min(surface.cell_m), about, smooth=True)

    def check(self, path: Path) -> None:
        """Decode the picture."""
        check_picture(path)


def _shaded(heights_m: npt.NDArray[np.float64], surface: SurfaceTile, light: SurfacePicturesOptions) -> Grey:
    """Returns the shade of the part of the tile that has heights, north up, in square pixels."""
    rows, columns = _seen(surface)
    part = heights_m[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1][::-1]
    east_m, north_m = surface.cell_m
    grey = shade(part, east_m, light, north_m)
    least = min(east_m, north_m)
    return np.repeat(np.repeat(grey, round(north_m / least), axis=0), round(east_m / least), axis=1)


def _seen(surface: SurfaceTile) -> tuple[slice, slice]:
    """Returns row and column slices of the smallest box of the tile's cells with a height."""
    known = surface.origin[surface.inner] != EMPTY
    spans = [np.flatnonzero(known.any(axis=axis)) + surface.halo for axis in (1, 0)]
    rows, columns = (slice(int(s[0]), int(s[-1]) + 1) for s in spans)
    return rows, columns
