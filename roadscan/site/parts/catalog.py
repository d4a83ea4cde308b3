"""A catalogue for other programs: STAC 1.1, its items as GeoParquet, and a virtual point cloud.

A survey is a collection and a kilometre sheet an item. A local frame has no place on the Earth, and so no catalogue.
"""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from roadscan.core.crs import MapFrame, crs_from_text
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.core.grid import TileId
from roadscan.run.keys import code_digest, key_of
from roadscan.site.document import Ask, Document, SitePart, json_document
from roadscan.site.material import Material
from roadscan.site.parts.clouds import cloud_box_m, cloud_sheets, cloud_url
from roadscan.site.parts.rasters import cog_records, cog_url
from roadscan.site.parts.vectors import features_url, site_layers
from roadscan.store.codecs import SOFTWARE

STAC: Final = "1.1.0"
_PROJECTION: Final = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
_POINT_CLOUD: Final = "https://stac-extensions.github.io/pointcloud/v2.0.0/schema.json"
_COPC_TYPE: Final = "application/vnd.laszip+copc"
_FEATURES_TYPE: Final = "application/vnd.flatgeobuf"
_COG_TYPE: Final = "image/tiff; application=geotiff; profile=cloud-optimized"
_DENSE: Final = 20
"""Points along each edge of a sheet, whose border is not straight in longitude and latitude."""
_DIMENSIONS: Final = (
    ("X", 8, "floating"), ("Y", 8, "floating"), ("Z", 8, "floating"), ("Intensity", 2, "unsigned"),
    ("ReturnNumber", 1, "unsigned"), ("NumberOfReturns", 1, "unsigned"), ("Classification", 1, "unsigned"),
    ("ScanAngleRank", 4, "floating"), ("UserData", 1, "unsigned"), ("PointSourceId", 2, "unsigned"),
    ("GpsTime", 8, "floating"),
)  # fmt: skip


class Catalog(SitePart):
    """A collection with one item per sheet."""

    name = "catalog"
    position = 150

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the paths of its files."""
        if not is_placed(material):
            return {"catalog": None}
        points = "catalog/points.vpc" if cloud_sheets(material) else None
        return {
            "catalog": {"collection": "catalog/collection.json", "items": "catalog/items.parquet", "points": points}
        }

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield all documents."""
        if not is_placed(material):
            return
        items = [_item(material, name, tiles) for name, tiles in material.sheets.items()]
        yield json_document("catalog/collection.json", _collection(material, items))
        for item in items:
            yield json_document(f"catalog/items/{item['id']}.json", item)
        yield _items_table(items)
        clouds = cloud_sheets(material)
        if clouds:
            features = [_virtual(material, item, clouds[item["id"]]) for item in items if item["id"] in clouds]
            yield json_document("catalog/points.vpc", {"type": "FeatureCollection", "features": features})


def is_placed(material: Material) -> bool:
    """Return True where the survey has tiles and its map a place on the Earth."""
    return bool(material.tiles) and material.context.map.crs is not None


def to_longitude_latitude(frame: MapFrame) -> Any:
    """Return a function from easting and northing (n, 2; m) to longitude and latitude (degrees, WGS 84)."""
    from pyproj import Transformer

    turned = Transformer.from_crs(crs_from_text(frame.crs or ""), "OGC:CRS84", always_xy=True)
    unit_m = frame.horizontal_unit_m

    def places(xy_m: Any) -> Any:
        return np.stack(turned.transform(xy_m[:, 0] / unit_m, xy_m[:, 1] / unit_m), axis=-1)

    return places


def from_longitude_latitude(frame: MapFrame) -> Any:
    """Return a function from longitude and latitude (n, 2; degrees, WGS 84) to easting and northing (m)."""
    from pyproj import Transformer

    turned = Transformer.from_crs("OGC:CRS84", crs_from_text(frame.crs or ""), always_xy=True)
    unit_m = frame.horizontal_unit_m
    return lambda lon_lat: np.stack(turned.transform(lon_lat[:, 0], lon_lat[:, 1]), axis=-1) * unit_m


def _sheet_box(material: Material, tiles: Sequence[TileId]) -> tuple[float, float, float, float]:
    boxes = [material.context.grid.bounds(t) for t in tiles]
    return (
        min(b.easting_min_m for b in boxes), min(b.northing_min_m for b in boxes),
        max(b.easting_max_m for b in boxes), max(b.northing_max_m for b in boxes),
    )  # fmt: skip


def _times(material: Material, tiles: Sequence[TileId]) -> tuple[str, str]:
    """Return the first and last instant (UTC) of tiles."""
    held = [material.summaries[t] for t in tiles if t in material.summaries]
    ends = min(s.first_epoch_gps_ns for s in held), max(s.last_epoch_gps_ns for s in held)
    first, last = (utc_from_gps_ns(one).astimezone(dt.UTC) for one in ends)
    return first.strftime("%Y-%m-%dT%H:%M:%SZ"), last.strftime("%Y-%m-%dT%H:%M:%SZ")


def _item(material: Material, name: str, tiles: Sequence[TileId]) -> dict[str, Any]:
    box, frame = _sheet_box(material, tiles), material.context.map
    dense = shapely.segmentize(shapely.box(*box), max(box[2] - box[0], box[3] - box[1]) / _DENSE)
    border = shapely.transform(dense, to_longitude_latitude(frame))
    ring = np.round(shapely.get_coordinates(border), 8).tolist()
    first, last = _times(material, tiles)
    unit_m = frame.horizontal_unit_m
    return {
        "type": "Feature", "stac_version": STAC, "stac_extensions": [_PROJECTION], "id": name,
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "bbox": [round(v, 8) for v in border.bounds],
        "properties": {
            "title": f"{material.context.survey_id}, sheet {name}", "datetime": first, "start_datetime": first,
            "end_datetime": last, "proj:code": _code(frame), "proj:bbox": [v / unit_m for v in box],
            **({} if _code(frame) else {"proj:wkt2": frame.wkt()}),
        },
        "collection": material.context.survey_id,
        "links": [
            {"rel": "root", "href": "../collection.json", "type": "application/json"},
            {"rel": "parent", "href": "../collection.json", "type": "application/json"},
            {"rel": "collection", "href": "../collection.json", "type": "application/json"},
        ],
        "assets": dict(_assets(material, name, "../../")),
    }  # fmt: skip


def _assets(material: Material, sheet: str, up: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the assets of a sheet: its points, and the GeoTIFFs with its name."""
    if sheet in cloud_sheets(material):
        yield "points", {"href": up + cloud_url(sheet), "type": _COPC_TYPE, "roles": ["data"], "title": "Points (COPC)"}
    for record in cog_records(material):
        stem = record.path.rsplit("/", 1)[-1]
        if stem.endswith(f"_{sheet}.tif") or (len(material.sheets) == 1 and stem.endswith(".tif")):
            title = stem.removesuffix(".tif")
            asset = {"href": up + cog_url(record), "type": _COG_TYPE, "roles": ["data"], "title": title}
            yield f"{record.product}-{title}", asset


def projection_of(frame: MapFrame) -> tuple[list[str], dict[str, Any]]:
    """Return the extension and the properties by which an item tells its map."""
    return [_PROJECTION], {"proj:code": _code(frame), **({} if _code(frame) else {"proj:wkt2": frame.wkt()})}


def _code(frame: MapFrame) -> str | None:
    """Return authority and number of the horizontal CRS, where it has one."""
    found = crs_from_text(frame.crs or "").to_authority() if frame.crs else None
    return None if found is None else ":".join(found)


def _collection(material: Material, items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    boxes = np.array([item["bbox"] for item in items])
    whole = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]
    spans = [(i["properties"]["start_datetime"], i["properties"]["end_datetime"]) for i in items]
    links = [{"rel": "root", "href": "./collection.json", "type": "application/json"}]
    links += [{"rel": "item", "href": f"./items/{i['id']}.json", "type": "application/geo+json"} for i in items]
    return {
        "type": "Collection", "stac_version": STAC, "stac_extensions": [], "id": material.context.survey_id,
        "title": material.context.title or material.context.survey_id,
        "description": f"Road survey {material.context.survey_id}, a sheet a kilometre of the map.",
        "license": "other", "keywords": ["road survey", "point cloud", "pavement"],
        "extent": {
            "spatial": {"bbox": [whole]},
            "temporal": {"interval": [[min(s[0] for s in spans), max(s[1] for s in spans)]]},
        },
        "summaries": {"processing:software": {"roadscan": SOFTWARE.split()[-1]}},
        "links": links,
        "assets": {
            "items": {
                "href": "./items.parquet", "type": "application/vnd.apache.parquet", "roles": ["metadata"],
                "title": "Items as GeoParquet",
            },
            **{
                layer.name: {
                    "href": f"../{features_url(layer)}", "type": _FEATURES_TYPE, "roles": ["data"],
                    "title": f"{layer.title} (FlatGeobuf)",
                }
                for layer in site_layers(material)[0]
            },
        },
    }  # fmt: skip


def _items_table(items: Sequence[Mapping[str, Any]]) -> Document:
    """Return the items as rows (stac-geoparquet 1.1): properties are columns, assets and links are kept."""
    rows = []
    for item in items:
        told = {name: value for name, value in item.items() if name not in ("properties", "geometry", "bbox", "assets")}
        told["bbox"] = dict(zip(("xmin", "ymin", "xmax", "ymax"), item["bbox"], strict=True))
        times = ("datetime", "start_datetime", "end_datetime")
        told |= {n: dt.datetime.fromisoformat(v) if n in times else v for n, v in item["properties"].items()}
        told["assets"] = {name: item["assets"].get(name) for name in sorted({k for i in items for k in i["assets"]})}
        told["geometry"] = shapely.to_wkb(shapely.Polygon(item["geometry"]["coordinates"][0]))
        rows.append(told if told["assets"] else {k: v for k, v in told.items() if k != "assets"})
    column = {"encoding": "WKB", "geometry_types": ["Polygon"], "crs": None, "bbox": []}
    boxes = np.array([item["bbox"] for item in items])
    column["bbox"] = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]
    column.pop("crs")  # the default is longitude and latitude in WGS 84
    about = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}

    def write(path: Path, _ask: Ask) -> None:
        table = pa.Table.from_pylist(rows)
        table = table.replace_schema_metadata({"geo": json.dumps(about, sort_keys=True)})
        pq.write_table(table, path, compression="zstd", version="2.6", write_page_checksum=True)

    return Document("catalog/items.parquet", key_of(code_digest(f"{__name__}"), items), write)


def _virtual(material: Material, item: Mapping[str, Any], tiles: Sequence[TileId]) -> dict[str, Any]:
    """Return an item of a virtual point cloud, as PDAL Wrench makes it and QGIS reads it."""
    frame = material.context.map
    box_m = cloud_box_m(material, tiles)
    units = (frame.horizontal_unit_m, frame.horizontal_unit_m, frame.vertical_unit_m)
    box = [v / u for v, u in zip(box_m, units * 2, strict=True)]
    flat, heights = item["bbox"], (box_m[2], box_m[5])
    told = {n: v for n, v in item["properties"].items() if not n.startswith("proj:")}
    return {
        "type": "Feature", "stac_version": "1.0.0", "id": item["id"], "geometry": item["geometry"],
        "stac_extensions": [_PROJECTION.replace("v2.0.0", "v1.1.0"), _POINT_CLOUD.replace("v2.0.0", "v1.0.0")],
        "bbox": [flat[0], flat[1], heights[0], flat[2], flat[3], heights[1]],
        "properties": {
            **told, "pc:count": sum(material.summaries[t].points for t in tiles), "pc:encoding": _COPC_TYPE,
            "pc:type": "lidar", "pc:schemas": [{"name": n, "size": s, "type": t} for n, s, t in _DIMENSIONS],
            "proj:bbox": box, "proj:wkt2": frame.wkt(),
        },
        "links": [],
        "assets": {"data": {"href": f"../{cloud_url(item['id'])}", "roles": ["data"], "type": _COPC_TYPE}},
    }  # fmt: skip
