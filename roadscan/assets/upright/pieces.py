"""Pieces of things at a place, and their objects: a point belongs to the tile that contains its foot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.scene import Scene
from roadscan.compute.array_types import Int64

_COMMON: Final = (
    ("easting_m", pa.float64()), ("northing_m", pa.float64()), ("height_m", pa.float64()),
    ("sigma_horizontal_m", pa.float64()), ("sigma_height_m", pa.float64()), ("sigma_size_m", pa.float64()),
    ("probability", pa.float64()),
    ("returns", pa.int64()), ("passes", pa.list_(pa.int32())), ("first_epoch_gps_ns", pa.int64()),
    ("last_epoch_gps_ns", pa.int64()),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Place:
    """Something at a place of a scene."""

    x_m: float
    """From the corner of the returns, as y."""
    y_m: float
    height_m: float
    sigma_horizontal_m: float
    sigma_height_m: float
    probability: float
    rows: Int64
    """Returns that show it."""
    attributes: Mapping[str, float | str | None]
    sigma_size_m: float | None = None


def schema_of(numbers: Sequence[str], texts: Sequence[str] = ()) -> pa.Schema:
    """Returns the schema of a kind's pieces with these values of its own."""
    own = [(name, pa.float64()) for name in numbers] + [(name, pa.string()) for name in texts]
    return pa.schema([*_COMMON, *own])


def passes_of(scene: Scene, rows: Int64) -> list[int]:
    """Returns passes that saw some returns, ascending."""
    out: list[int] = np.flatnonzero(np.bincount(scene.returns.pass_id[rows])).tolist()
    return out


def seen_by(scene: Scene, rows: Int64) -> dict[str, Any]:
    """Returns number of returns, passes (ascending), first and last epoch of some returns."""
    epochs = scene.returns.epoch_gps_ns[rows]
    return {
        "returns": int(rows.size),
        "passes": passes_of(scene, rows),
        "first_epoch_gps_ns": int(epochs.min()),
        "last_epoch_gps_ns": int(epochs.max()),
    }


def seen_by_each(scene: Scene, rows: Int64, starts: Int64) -> dict[str, npt.ArrayLike | pa.Array]:
    """Returns the same (k,) of groups of returns, of which none is empty: `rows` from `starts` (k + 1,) of each."""
    epochs, number = scene.returns.epoch_gps_ns[rows], np.diff(starts)
    passes = scene.returns.pass_id[rows].astype(np.int64)
    many = int(passes.max(initial=0)) + 1
    group, seen = np.divmod(np.unique(np.repeat(np.arange(number.size), number) * many + passes), many)
    first = np.searchsorted(group, np.arange(number.size + 1))
    return {
        "returns": number,
        "passes": pa.ListArray.from_arrays(pa.array(first, pa.int32()), pa.array(seen, pa.int32())),
        "first_epoch_gps_ns": np.minimum.reduceat(epochs, starts[:-1]),
        "last_epoch_gps_ns": np.maximum.reduceat(epochs, starts[:-1]),
    }


def pieces_of(scene: Scene, places: Iterable[Place], schema: pa.Schema) -> pa.Table:
    """Returns the table of the things that stand in the scene's tile."""
    east, north = scene.returns.corner_m
    rows = [
        {
            "easting_m": east + p.x_m, "northing_m": north + p.y_m, "height_m": p.height_m,
            "sigma_horizontal_m": p.sigma_horizontal_m, "sigma_height_m": p.sigma_height_m,
            "sigma_size_m": p.sigma_size_m, "probability": p.probability, **seen_by(scene, p.rows),
            **{n: p.attributes.get(n) for n in schema.names[len(_COMMON) :]},
        }
        for p in places
        if bool(scene.tile.holds(p.x_m, p.y_m))
    ]  # fmt: skip
    return pa.Table.from_pylist(rows, schema=schema)


def objects_at_places(pieces: pa.Table, apart_m: float) -> list[AssetObject]:
    """Object for each piece, by easting and northing; of pieces nearer than `apart_m` the one with most returns.

    Two tiles that see one thing a little differently may both contain its foot. Plates that face away from each other
    are two.
    """
    rows = pieces.to_pylist()
    rows.sort(key=lambda r: (-r["returns"], r["easting_m"], r["northing_m"]))
    kept: list[dict[str, Any]] = []
    taken: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for row in rows:
        cell = (int(row["easting_m"] // apart_m), int(row["northing_m"] // apart_m))
        about = [r for i in (-1, 0, 1) for j in (-1, 0, 1) for r in taken.get((cell[0] + i, cell[1] + j), ())]
        if all(_distance(row, other) >= apart_m or _back_to_back(row, other) for other in about):
            kept.append(row)
            taken.setdefault(cell, []).append(row)
    kept.sort(key=lambda r: (r["easting_m"], r["northing_m"], r["height_m"]))
    names = pieces.schema.names[len(_COMMON) :]
    return [_object(row, names) for row in kept]


def _distance(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    return float(np.sqrt(sum((first[name] - second[name]) ** 2 for name in ("easting_m", "northing_m", "height_m"))))


def _back_to_back(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Returns whether two pieces with a front face opposite sides."""
    if "facing_deg" not in first:
        return False
    return bool(abs((first["facing_deg"] - second["facing_deg"] + 180.0) % 360.0 - 180.0) > 90.0)


def _object(row: Mapping[str, Any], names: Sequence[str]) -> AssetObject:
    return AssetObject(
        shapely.Point(row["easting_m"], row["northing_m"], row["height_m"]), row["sigma_horizontal_m"],
        row["sigma_height_m"], row["probability"], row["returns"], len(row["passes"]), row["first_epoch_gps_ns"],
        row["last_epoch_gps_ns"], {name: row[name] for name in names}, row["sigma_size_m"],
    )  # fmt: skip
