"""Pictures for other programs: a STAC 1.1 collection with an item a picture, its footprint, orientation and σ."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import shapely

from roadscan.pictures.placed import Pictures as PlacedPictures
from roadscan.site.document import Document, json_document
from roadscan.site.material import Material
from roadscan.site.part import SitePart
from roadscan.site.parts.catalog import STAC, is_placed, projection_of, to_longitude_latitude
from roadscan.site.site_pictures import picture_url, placed_pictures
from roadscan.store.codecs import SOFTWARE

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
