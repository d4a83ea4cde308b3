"""Selection of the pictures that show assets best: from the front, inside the picture, and unobstructed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets.kernels.sight_lines import find_hidden
from roadscan.assets.pictures.reader import Sight
from roadscan.assets.screens import EDGE_M
from roadscan.compute.array_types import Float64
from roadscan.pictures.colours import world_places
from roadscan.pictures.placed import Pictures
from roadscan.pictures.views import Sights, sights

_WALKED_M: Final = np.array([1.5, 0.8, 0.25])
"""A line of sight is tested from this far beyond the camera to this far before the object, in steps of this (m)."""


def best_sights(looks: Sequence[Sight], pictures: Pictures, screens: pa.Table) -> Sights:
    """Returns the pictures that show n objects, each object's best first, without those in which something hides it.

    Parameters
    ----------
    looks : what a picture must show of each object, with the same number of places each.
    screens : voxels that hide (:data:`roadscan.assets.screens.SCREENS`).
    """
    places = np.stack([one.places_m for one in looks])
    flat = places.reshape(-1, 3)
    front = np.array([np.full(3, np.nan) if one.facing is None else one.facing for one in looks])
    worlds, fronts = [], []
    for world in pictures.worlds:
        own = world_places(pictures, world, flat).reshape(places.shape)
        worlds.append(own)
        ahead = world_places(pictures, world, places[:, 0] + np.nan_to_num(front)) - own[:, 0]
        fronts.append(np.where(np.isnan(front), np.nan, ahead))
    every = np.arange(len(looks))
    found = sights(worlds, fronts, pictures.views, pictures.rule, ((n, every) for n in range(len(pictures))))
    return found.at(~_hidden(found, places[:, 0], pictures, screens))


def _hidden(found: Sights, places_m: Float64, pictures: Pictures, screens: pa.Table) -> npt.NDArray[np.bool_]:
    """Returns a mask (n,) of the sights that are obstructed."""
    hidden = np.zeros(len(found), np.bool_)
    if not (len(found) and screens.num_rows):
        return hidden
    voxel = np.column_stack([screens[name].to_numpy() for name in ("column", "row", "level")]).astype(np.int64)
    low = voxel.min(axis=0)
    shape = voxel.max(axis=0) - low + 1
    key = ((voxel[:, 0] - low[0]) * shape[1] + voxel[:, 1] - low[1]) * shape[2] + voxel[:, 2] - low[2]
    order = np.argsort(key, kind="stable")
    spans = np.column_stack([screens[name].to_numpy() for name in ("first_epoch_gps_ns", "last_epoch_gps_ns")])
    eyes, corner = _eyes_m(pictures), low * EDGE_M
    find_hidden(
        np.ascontiguousarray(eyes[found.view] - corner), np.ascontiguousarray(places_m[found.item] - corner),
        pictures.epochs_gps_ns[found.view], key[order], np.ascontiguousarray(spans[order]), shape, EDGE_M, _WALKED_M,
        hidden,
    )  # fmt: skip
    return hidden


def _eyes_m(pictures: Pictures) -> Float64:
    """Returns easting, northing and height (n, 3) of the cameras."""
    views = pictures.views
    out = np.empty((len(views), 3))
    for number, world in enumerate(pictures.worlds):
        own = views.world == number
        out[own] = pictures.map.map_from_world(world, views.eye_world_m[own])
    return out


def named(found: Sights, pictures: Pictures, count: int, most: int) -> list[str | None]:
    """Returns the column `pictures` of `count` objects; None where no picture shows one."""
    words: list[list[dict[str, object]]] = [[] for _ in range(count)]
    for item, view, (u, v), distance in zip(
        found.item.tolist(), found.view.tolist(), found.pixel.tolist(), found.distance_m.tolist(), strict=True
    ):
        if len(words[item]) < most:
            log = pictures.logs[pictures.log[view]]
            words[item].append(
                {
                    "run": log.run, "camera": log.sensor, "file": pictures.files[view],
                    "epoch_gps_ns": int(pictures.epochs_gps_ns[view]), "u_px": round(u, 1), "v_px": round(v, 1),
                    "distance_m": round(distance, 2),
                }
            )  # fmt: skip
    return [json.dumps(one, ensure_ascii=False) if one else None for one in words]
