"""Transformation of a home's geometries into the map's CRS, whatever CRS a person exported them to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from roadscan.core.crs import MapFrame, accuracy_words, best_operation, crs_from_text
from roadscan.core.errors import CrsError
from roadscan.core.witness import Witness
from roadscan.inventory.home import HomeError

CRS_OF_EDITS: Final = Witness(
    name="crs_of_edits",
    input="inventory edits",
    fault="A layer was exported to another CRS than the map's, or states none.",
    asks="the CRS that the layer states (of PostGIS: the SRID of each geometry), against that of the map",
    does="coordinates are transformed where PROJ knows the operation within map.max_datum_error_m; otherwise the layer "
    "is refused",
    told=("error",),
)

Shapes = npt.NDArray[Any]
_WAY_OUT: Final = "export the layer in the map's CRS, with heights as the map has them, and pull again"


def into_map(stated: str | None, frame: MapFrame, layer: str, home: str) -> Callable[[Shapes], Shapes]:
    """Returns the transformation of a layer's geometries into the map.

    Parameters
    ----------
    stated : CRS that the layer states, as PROJ reads it; None where it states none.
    layer, home : as errors name them.

    Raises
    ------
    HomeError
        where the layer states no CRS and the map has one, or the reverse; or PROJ does not know the operation exactly.
    """
    crs = None if stated is None else _known(stated, layer, home)
    if crs is not None and (crs.is_engineering or crs.name.startswith("Undefined")):
        crs = None
    if frame.crs is None or crs is None:
        if frame.crs is None and crs is None:
            return lambda shapes: shapes
        arrived = "states no CRS" if crs is None else f"is in {_title(crs)}"
        raise HomeError(
            f"the layer '{layer}' {arrived}",
            expected="a local frame, without a CRS" if frame.crs is None else f"the map's, {frame.crs}",
            change="give the layer the CRS that its coordinates are in" if crs is None else _WAY_OUT,
            file=home,
        )
    target = crs_from_text(frame.crs)
    horizontal, is_3d = _parts(crs, frame, layer, home)
    if target.equals(horizontal, ignore_axis_order=True):
        return lambda shapes: shapes
    if is_3d:
        horizontal, target = horizontal.to_3d(), target.to_3d()
    operation = _operation(horizontal, target, frame.max_datum_error_m, layer, home)
    return lambda shapes: _transformed(shapes, operation, heights=is_3d)


def _known(stated: str, layer: str, home: str) -> pyproj.CRS:
    try:
        return crs_from_text(stated, f"the CRS of the layer '{layer}',")
    except CrsError as error:
        raise HomeError(str(error), change=_WAY_OUT, file=home) from error


def _parts(crs: pyproj.CRS, frame: MapFrame, layer: str, home: str) -> tuple[pyproj.CRS, bool]:
    """Returns the horizontal part of a layer's CRS, and whether its ellipsoidal heights are transformed too.

    A CRS of two axes has no heights: programs export them as they are.
    """
    if crs.is_compound:
        horizontal, vertical = crs.sub_crs_list[:2]
        if frame.vertical_crs is not None and crs_from_text(frame.vertical_crs).equals(vertical):
            return horizontal, False
    elif len(crs.axis_info) < 3:
        return crs, False
    elif frame.height == "ellipsoidal" and frame.vertical_unit_m == 1.0:
        return crs.to_2d(), True
    raise HomeError(
        f"the heights of the layer '{layer}' are those of {_title(crs)}",
        expected=f"{frame.height} heights of the map" + (f", {frame.vertical_crs}" if frame.vertical_crs else ""),
        change=_WAY_OUT,
        file=home,
    )


def _operation(source: pyproj.CRS, target: pyproj.CRS, limit_m: float, layer: str, home: str) -> pyproj.Transformer:
    best = best_operation(source, target)
    if best is not None and best.accuracy <= limit_m:
        return best
    raise HomeError(
        f"the layer '{layer}' is in {_title(source)}, and the way from there into the map's {_title(target)} is "
        f"{accuracy_words(best)}",
        expected=f"an operation within map.max_datum_error_m = {limit_m:g}",
        change=_WAY_OUT,
        file=home,
    )


def _transformed(shapes: Shapes, operation: pyproj.Transformer, *, heights: bool) -> Shapes:
    """Returns transformed geometries; empty and missing ones are unchanged."""

    def moved(places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        out = places.copy()
        used = 3 if heights and places.shape[1] == 3 and np.isfinite(places[:, 2]).all() else 2
        out[:, :used] = np.column_stack(operation.transform(*places[:, :used].T))
        return out

    out = shapes.copy()
    for has_z in (False, True):
        of_kind = (shapely.has_z(shapes) == has_z) & ~shapely.is_missing(shapes)
        if of_kind.any():
            out[of_kind] = shapely.transform(shapes[of_kind], moved, include_z=has_z)
    return out


def _title(crs: pyproj.CRS) -> str:
    authority = crs.to_authority()
    return crs.name if authority is None else f"{':'.join(authority)} ({crs.name})"
