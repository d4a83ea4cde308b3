"""Quantities of a cell that rasters show, with their bands and units."""

from __future__ import annotations

from typing import Any, Final, Literal, get_args

import numpy.typing as npt

from roadscan.store.codecs.cog import Band
from roadscan.tiles.cells import TileCells
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.raster import height_unit

Quantity = Literal["height", "intensity", "count", "height_std"]
"""Robust height, mean intensity, number of points, standard deviation of the heights."""

QUANTITIES: Final[tuple[Quantity, ...]] = get_args(Quantity)


def band_of(quantity: Quantity, context: ProductContext) -> Band:
    """Return the band that shows a quantity; heights are in the unit of the map's heights."""
    unit = height_unit(context.map)
    return {
        "height": Band("height", unit),
        "intensity": Band("intensity", "digital number"),
        "count": Band("count", "points"),
        "height_std": Band("height standard deviation", unit),
    }[quantity]


def values_of(quantity: Quantity, cells: TileCells, context: ProductContext) -> npt.NDArray[Any]:
    """Return (n,) values of a quantity, one a cell, in the unit of its band."""
    unit_m = context.map.vertical_unit_m
    match quantity:
        case "height":
            return cells.height_robust_m / unit_m
        case "intensity":
            return cells.intensity_mean
        case "count":
            return cells.count
        case "height_std":
            return cells.height_std_m.astype("float64") / unit_m
