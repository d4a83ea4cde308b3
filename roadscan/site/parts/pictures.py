"""Pictures of cameras with their poses, and cut-outs of assets."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import shapely

from roadscan.core.errors import DamagedError
from roadscan.georeference.picture_axes import camera_from_map
from roadscan.measuring.poses import picture_poses
from roadscan.navigation.tasks.recorded_pictures import taken_pictures
from roadscan.pictures.placed import Pictures as PlacedPictures
from roadscan.pictures.views import HEIGHT, WIDTH
from roadscan.privacy.detector import KINDS
from roadscan.privacy.hider import Hider, decoded, encoded
from roadscan.run.keys import code_digest, key_of
from roadscan.site.document import Ask, Document, SitePart, json_bytes, json_document
from roadscan.site.material import Material, sheet_name
from roadscan.site.parts.catalog import STAC, is_placed, projection_of, to_longitude_latitude
from roadscan.site.parts.vectors import site_layers
from roadscan.site.site_pictures import (
    SHOWN_AS_THEY_ARE,
    cut_out_records,
    cut_out_url,
    hider_for,
    picture_url,
    placed_pictures,
)
from roadscan.store.codecs import SOFTWARE
from roadscan.store.codecs.image_files import comment_of, with_comment
from roadscan.store.manifest import OutputRecord, read_recorded

_LENS: Final = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_CODE: Final = "roadscan.site.parts.pictures"
PRIVACY: Final = "pictures/privacy.json"
"""What was hidden in each picture."""


class Pictures(SitePart):
    """Pictures with a pose, by kilometre sheet of the camera."""

    name = "pictures"
    position = 600

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the path of the index, and what is done with people and vehicles in the pictures."""
        held = placed_pictures(material)
        told: dict[str, Any] = {"pictures": material.privacy}
        if material.privacy == "blur" and held is not None:
            told["counts"] = PRIVACY
        return {
            "pictures": {"url": "pictures/index.json", "pictures": len(held)} if held is not None else None,
            "privacy": told,
        }

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield the index, poses by sheet, and the pictures."""
        held = placed_pictures(material)
        if held is None:
            return
        sheets: dict[str, list[int]] = {}
        for number, (east, north) in enumerate(held.place_m.tolist()):
            sheets.setdefault(sheet_name(east, north), []).append(number)
        parts = [
            {"url": f"pictures/{name}.json", "bounds_m": _bounds(held, numbers), "pictures": len(numbers)}
            for name, numbers in sorted(sheets.items())
        ]
        epochs = _epochs(material, held)
        yield json_document("pictures/index.json", {"cameras": _cameras(held), "parts": parts})
        for name, numbers in sorted(sheets.items()):
            yield json_document(f"pictures/{name}.json", _poses(material, held, numbers, epochs))
        hider = hider_for(material)
        if hider is None:
            for number in range(len(held)):
                yield Document(picture_url(material, held, number), _key(held, number), _copied(held, number))
        else:
            yield from _hidden_pictures(material, held, hider)
        shown = {one.get("url") for layer in site_layers(material)[0] for row in layer.evidence for one in row}
        for record in cut_out_records(material).values():
            if cut_out_url(record) in shown:
                own = (record.digest,) if hider is None else (record.digest, hider.key)
                yield Document(cut_out_url(record), key_of(*own), _stored(material, record, hider))


def _stored(material: Material, record: OutputRecord, hider: Hider | None) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        content = read_recorded(material.store, record)
        path.write_bytes(content if hider is None else encoded(hider.hide_found(decoded(content))))

    return write


def _hidden_pictures(material: Material, held: PlacedPictures, hider: Hider) -> Iterator[Document]:
    """Yield pictures with people and vehicles hidden, and what was hidden in each."""
    keys = [key_of(_key(held, number), hider.key_of(held, number)) for number in range(len(held))]
    urls = [picture_url(material, held, number) for number in range(len(held))]
    for number, (url, key) in enumerate(zip(urls, keys, strict=True)):
        yield Document(url, key, _hidden(held, number, hider))

    def write(path: Path, ask: Ask) -> None:
        rows: dict[str, list[Any]] = {"url": [], **{what: [] for what in KINDS}}
        for url in urls:
            file = ask(url)
            if file.is_file():  # a damaged picture is left out, and named as a failure
                counts = json.loads(comment_of(file.read_bytes()))
                rows["url"].append(url)
                for what in KINDS:
                    rows[what].append(int(counts[what]))
        told = {
            "pictures": len(rows["url"]), "sources": hider.sources, "hidden": rows,
            "total": {what: sum(rows[what]) for what in KINDS},
        }  # fmt: skip
        path.write_bytes(json_bytes(told))

    yield Document(PRIVACY, key_of(code_digest(_CODE), keys, hider.sources), write)


def _hidden(held: PlacedPictures, number: int, hider: Hider) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        source = held.path(number)
        try:
            picture, counts = hider.hide(held, number, decoded(source.read_bytes()))
        except OSError as error:
            raise DamagedError(f"the picture {held.name(number)} cannot be read: {error}", file=source) from error
        path.write_bytes(with_comment(encoded(picture), json.dumps(counts, sort_keys=True)))

    return write


def _bounds(held: PlacedPictures, numbers: list[int]) -> list[float]:
    own = held.place_m[numbers]
    return [round(float(v), 3) for v in (*own.min(axis=0), *own.max(axis=0))]


def _cameras(held: PlacedPictures) -> list[dict[str, Any]]:
    found = []
    for number, log in enumerate(held.logs):
        own = np.flatnonzero(held.log == number)
        if not own.size:
            continue
        lens = held.views.lens_of(own[0])
        values = dict(zip(_LENS, lens.parameters.tolist(), strict=False))
        found.append(
            {
                "camera": number, "run": log.run, "title": log.sensor,
                "model": "equirectangular" if lens.is_around else "perspective",
                "width_px": round(float(lens.parameters[WIDTH])), "height_px": round(float(lens.parameters[HEIGHT])),
                "focal_px": [values["fx"], values["fy"]], "principal_px": [values["cx"], values["cy"]],
                "distortion": [values[n] for n in _LENS[4:]],
            }
        )  # fmt: skip
    return found


def _poses(material: Material, held: PlacedPictures, numbers: list[int], epochs: list[str]) -> dict[str, Any]:
    views = held.views.picked(np.array(numbers, np.int64))
    place, turn = np.empty((len(numbers), 3)), np.empty((len(numbers), 3, 3))
    for world, name in enumerate(held.worlds):
        own = views.world == world
        if own.any():
            place[own], turn[own] = camera_from_map(
                held.map, name, views.eye_world_m[own], views.opencv_from_world[own]
            )
    return {
        "pictures": len(numbers), "id": numbers, "camera": [int(held.log[k]) for k in numbers],
        "url": [picture_url(material, held, k) for k in numbers], "name": [held.name(k) for k in numbers],
        "epoch_gps_ns": [epochs[k] for k in numbers],
        "easting_m": np.round(place[:, 0], 5), "northing_m": np.round(place[:, 1], 5),
        "height_m": np.round(place[:, 2], 5), "camera_from_map": turn.reshape(-1, 9),
        "sigma_m": np.round(_sigma_m(material)[numbers], 4),
    }  # fmt: skip


@functools.lru_cache(maxsize=2)
def _sigma_m(material: Material) -> npt.NDArray[np.float64]:
    """Return the horizontal 1 σ (n,) of the projection centres, √(σ_north² + σ_east²)."""
    held = placed_pictures(material)
    if held is None:
        return np.zeros(0)
    spread = picture_poses(material.plan, held).covariance
    out: npt.NDArray[np.float64] = np.sqrt(spread[:, 0, 0] + spread[:, 1, 1])
    return out


def _epochs(material: Material, held: PlacedPictures) -> list[str]:
    """Return GPS time of each picture (ns) by its camera's estimated clock."""
    known: dict[tuple[str, str], int] = {}
    for log in held.logs:
        for taken in taken_pictures(material.store, material.plan.records, log.sensor):
            known |= {(taken.record.key, f): e for f, e in zip(taken.files, taken.epochs_gps_ns.tolist(), strict=True)}
    return [str(known[held.logs[log].key, file]) for log, file in zip(held.log.tolist(), held.files, strict=True)]


def _key(held: PlacedPictures, number: int) -> str:
    return key_of(code_digest(_CODE), held.logs[int(held.log[number])].key, held.files[number])


def _copied(held: PlacedPictures, number: int) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        source = held.path(number)
        try:
            if source.suffix.lower() in SHOWN_AS_THEY_ARE:
                path.write_bytes(source.read_bytes())
                return
            from PIL import Image

            with Image.open(source) as image:
                image.convert("RGB").save(path, format="JPEG", quality=90)
        except (OSError, SyntaxError, ValueError) as error:
            raise DamagedError(f"the picture {held.name(number)} cannot be read: {error}", file=source) from error

    return write


COLLECTION: Final = "picture_items/collection.json"
_TYPES: Final = {".jpg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
_TOLD: Final = (
    "yaw_deg", "pitch_deg", "roll_deg", "omega_deg", "phi_deg", "kappa_deg", "sigma_easting_m", "sigma_northing_m",
    "sigma_height_m", "sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg", "sigma_assumed", "easting_m", "northing_m",
    "height_m", "ellipsoidal_height_m", "model", "width_px", "height_px", "focal_x_px", "focal_y_px",
)  # fmt: skip
"""Columns of the table `pictures` that an item has as properties ``roadscan:…``."""
_PLAIN: Final = re.compile(r"[^A-Za-z0-9_-]+")
_DECIMALS: Final = 9  # Decimals of degrees: 0.1 mm.


class PictureItems(SitePart):
    """A collection with one item per published picture; none where the stage `pictures` has not run."""

    name = "picture_items"
    position = 650

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the path of the collection."""
        return {"picture_items": COLLECTION if _held(material) is not None else None}

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield the collection and its items."""
        found = _held(material)
        if found is None:
            return
        held, rows = found
        items = list(_items(material, held, rows))
        if items:
            yield json_document(COLLECTION, _collection(material, items))
        for item in items:
            yield json_document(f"picture_items/{item['id']}.json", item)


def _held(material: Material) -> tuple[PlacedPictures, dict[tuple[str, str, str, int], dict[str, Any]]] | None:
    """Return the published pictures and their rows; None where there are none, or the map has no place."""
    held = placed_pictures(material)
    if held is None or not is_placed(material):
        return None
    table = material.table("pictures")
    if table is None:
        return None
    rows = {(r["run"], r["camera"], r["file"], r["epoch_gps_ns"]): r for r in table.rows.to_pylist()}
    return held, rows


def _items(
    material: Material, held: PlacedPictures, rows: Mapping[tuple[str, str, str, int], dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Yield the items of the pictures that the table knows, in order of time."""
    frame = material.context.map
    to_degrees = to_longitude_latitude(frame)
    unit_m = frame.horizontal_unit_m
    for number, epoch in enumerate(held.epochs_gps_ns.tolist()):
        log = held.logs[held.log[number]]
        row = rows.get((log.run, log.sensor, held.files[number], epoch))
        if row is None or row["easting_m"] is None:
            continue
        shape = shapely.Point(row["easting_m"], row["northing_m"])
        if row["footprint"] is not None:
            seen = shapely.force_2d(shapely.from_wkb(row["footprint"]))
            shape = shapely.transform(seen, lambda xy: xy * unit_m)
        shape = shapely.transform(shape, lambda xy: np.round(to_degrees(xy), _DECIMALS))
        url = picture_url(material, held, number)
        kind = _TYPES[url[url.rindex(".") :]]
        parent = [{"rel": rel, "href": "./collection.json", "type": "application/json"}
                  for rel in ("root", "parent", "collection")]  # fmt: skip
        yield {
            "type": "Feature", "stac_version": STAC, "stac_extensions": projection_of(frame)[0],
            "id": _PLAIN.sub("-", f"{log.run}-{log.sensor}-{number:06d}"), "collection": _name(material),
            "geometry": shapely.geometry.mapping(shape), "bbox": list(shape.bounds),
            "properties": {
                "datetime": row["utc"], "title": held.name(number), **projection_of(frame)[1],
                **{f"roadscan:{name}": row[name] for name in _TOLD if row[name] is not None},
            },
            "links": parent,
            "assets": {"picture": {"href": f"../{url}", "type": kind, "roles": ["data"], "title": held.files[number]}},
        }  # fmt: skip


def _name(material: Material) -> str:
    return f"{material.context.survey_id}-pictures"


def _collection(material: Material, items: list[dict[str, Any]]) -> dict[str, Any]:
    boxes = np.array([item["bbox"] for item in items])
    times = sorted(item["properties"]["datetime"] for item in items)
    links = [{"rel": "root", "href": "./collection.json", "type": "application/json"}]
    links += [{"rel": "item", "href": f"./{item['id']}.json", "type": "application/geo+json"} for item in items]
    return {
        "type": "Collection", "stac_version": STAC, "stac_extensions": [], "id": _name(material),
        "title": f"Pictures of {material.context.title or material.context.survey_id}",
        "description": f"Pictures of road survey {material.context.survey_id}: places, orientations and footprints.",
        "license": "other", "keywords": ["road survey", "pictures"],
        "extent": {
            "spatial": {"bbox": [[*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]]},
            "temporal": {"interval": [[times[0], times[-1]]]},
        },
        "summaries": {"processing:software": {"roadscan": SOFTWARE.split()[-1]}}, "links": links, "assets": {},
    }  # fmt: skip
