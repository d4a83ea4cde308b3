"""Values of assets as edits encode them, and their differences in σ."""

from __future__ import annotations

import datetime as dt
import functools
import json
import math
from collections.abc import Callable, Mapping
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.store.asset_schema import GEOMETRY, asset_columns, asset_table

SIGMA_LEAST_M: Final = 0.005
"""Least σ that is assumed of any evidence (m)."""
_SIGMA_DEG: Final = 2.0  # σ of a measured angle (degrees).
_SIGMA_SLOPE: Final = 0.005  # σ of a measured slope (m/m).
_SIGMA_RATIO: Final = 0.1  # σ of a measured ratio.


def encoded(value: Any) -> str:
    """Returns a value as JSON: dates as ISO 8601, geometries (bytes) as hexadecimal WKB."""
    if isinstance(value, bytes):
        value = value.hex()
    elif isinstance(value, dt.date):
        value = value.isoformat()
    elif isinstance(value, np.generic):
        value = value.item()
    return json.dumps(value, ensure_ascii=False)


def encoded_column(values: list[Any]) -> list[str | None]:
    """Returns values of a column as :func:`encoded` writes them, None where there is none."""
    kinds = {type(v) for v in values} - {type(None)}
    if kinds == {bytes}:
        return [None if v is None else f'"{v.hex()}"' for v in values]
    if kinds == {float}:  # as in JSON but for infinities, which repr writes otherwise
        return [None if v is None else repr(v) if math.isfinite(v) else encoded(v) for v in values]
    told: dict[Any, str | None] = {v: encoded(v) for v in set(values)} | {None: None}
    return [told[v] for v in values]


def decoded(kind: str, attribute: str, text: str | None) -> Any:
    """Returns the value that :func:`encoded` wrote, in the type of the kind's column."""
    value = None if text is None else json.loads(text)
    if value is None:
        return None
    if attribute == GEOMETRY:
        return bytes.fromhex(value)
    return dt.date.fromisoformat(value) if pa.types.is_date(asset_table(kind).field(attribute).type) else value


def iso_wkb(geometries: npt.NDArray[Any]) -> list[bytes | None]:
    """Returns geometries as ISO WKB, little-endian, with heights where they have them: same place, same bytes."""
    return list(shapely.to_wkb(geometries, flavor="iso", byte_order=1))


def iso_column(column: pa.ChunkedArray) -> pa.Array:
    """Returns a column of WKB of any flavour as ISO WKB."""
    return pa.array(iso_wkb(shapely.from_wkb(column.to_numpy(zero_copy_only=False))), pa.binary())


def sigmas_apart(
    kind: str, attribute: str, one: Any, other: Any, row: Mapping[str, Any], units_m: tuple[float, float] = (1.0, 1.0)
) -> float:
    """Returns the difference of two values of an attribute in σ; infinity where they differ and have no σ.

    Parameters
    ----------
    row : the asset, whose `sigma_horizontal_m` and `sigma_height_m` are those of its evidence. Lengths are differences
        of two of its points; of angles, slopes and ratios the σ is that of the method (2°, 0.005, 0.1).
    units_m : metres of a unit of geometries, horizontally and in height.
    """
    if one == other:
        return 0.0
    if one is None or other is None:
        return math.inf
    horizontal = max(row.get("sigma_horizontal_m") or 0.0, SIGMA_LEAST_M)
    height = max(row.get("sigma_height_m") or 0.0, SIGMA_LEAST_M)
    if attribute == GEOMETRY:
        return geometries_apart(one, other, horizontal / units_m[0], height / units_m[1])
    sigma = sigma_of(kind, attribute)
    if sigma is None or isinstance(one, str):
        return math.inf
    return float(abs(one - other) / sigma(horizontal, height, max(abs(one), abs(other))))


def geometries_apart(one: bytes, other: bytes, horizontal: float, height: float) -> float:
    """Returns the difference of two places in σ (map units): of points horizontally and in height, else Hausdorff."""
    first, second = shapely.from_wkb(one), shapely.from_wkb(other)
    if first.geom_type == second.geom_type == "Point":
        rise = abs(first.z - second.z) if first.has_z and second.has_z else 0.0
        return max(math.hypot(first.x - second.x, first.y - second.y) / horizontal, rise / height)
    return float(shapely.hausdorff_distance(first, second)) / horizontal


Sigma: TypeAlias = Callable[[Any, Any, Any], Any]
"""Function from σ horizontal, σ in height and the value to the σ of an attribute, each a number or an array."""


@functools.cache
def sigma_of(kind: str, attribute: str) -> Sigma | None:
    """Returns how σ of a number follows from those of the place; None for texts, and where any difference counts."""
    column = next((c for c in asset_columns(kind) if c.name == attribute and c.type == "float64"), None)
    if column is None:
        return None
    of_unit: dict[str, Sigma] = {
        "m": lambda horizontal, height, _: np.hypot(horizontal, height),
        "m²": lambda horizontal, _, area: np.maximum(2.0 * np.sqrt(area) * horizontal, SIGMA_LEAST_M),
        "deg": lambda horizontal, *_: _SIGMA_DEG + 0.0 * horizontal,
        "m/m": lambda horizontal, *_: _SIGMA_SLOPE + 0.0 * horizontal,
        "1": lambda horizontal, *_: _SIGMA_RATIO + 0.0 * horizontal,
    }
    of_place, share = of_unit.get(column.unit), column.sigma_share
    if not share:
        return of_place
    return lambda horizontal, height, value: np.maximum(
        of_place(horizontal, height, value) if of_place else 0.0, np.maximum(share * value, SIGMA_LEAST_M)
    )
