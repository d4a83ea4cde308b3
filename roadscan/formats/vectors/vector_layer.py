"""Shared parts of the formats of points and lines: vector layers as GDAL reads them."""

from __future__ import annotations

import json
import sqlite3
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyproj
import shapely

from roadscan.core.errors import ConfigError, FormatError, Missing, RoadscanError, nearest
from roadscan.ingest.reading.format import Reject

BATCH_FEATURES: Final = 4_096  # features of a batch
_LARGEST_JSON: Final = 16 << 20  # larger GeoJSON files are not searched for unread features
LINE_KINDS: Final = frozenset({"LINESTRING", "MULTILINESTRING", "COMPOUNDCURVE", "MULTICURVE", "CURVE"})
"""Geometry types of GeoPackage layers with lines."""

_SQLITE: Final = b"SQLite format 3\x00"
_GEOPACKAGE_IDS: Final = (b"GPKG", b"GP10", b"GP11")


def is_geopackage(head: bytes) -> bool:
    """Return True for the first bytes of a GeoPackage."""
    return head.startswith(_SQLITE) and head[68:72] in _GEOPACKAGE_IDS


def geopackage_kinds(path: Path) -> frozenset[str]:
    """Return the geometry types of a GeoPackage's layers, in capitals; empty where unreadable. Never raises."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
            rows = base.execute("SELECT geometry_type_name FROM gpkg_geometry_columns LIMIT 1000").fetchall()
    except (sqlite3.Error, OSError, ValueError, OverflowError):
        return frozenset()
    return frozenset(str(row[0]).upper() for row in rows)


def gdal_name(path: Path) -> str:
    """Return the name with which GDAL opens a file, even a zipped one."""
    return f"/vsizip/{path}" if path.suffix.lower() == ".zip" else str(path)


@contextmanager
def gdal_faults(path: Path, expected: str = "GeoJSON or GeoPackage points") -> Iterator[None]:
    """Raise GDAL's errors about the file as FormatError, and suppress its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except RoadscanError:
            raise
        except UnboundLocalError as error:  # pyogrio (0.13) on a CRS that GDAL cannot export
            raise FormatError("GDAL cannot understand the layer's CRS", expected="WKT", file=path) from error
        except (RuntimeError, ValueError, OSError, pa.ArrowException) as error:
            raise FormatError(f"GDAL cannot read the file: {error}", expected=expected, file=path) from error


def layer_names(path: Path) -> list[str]:
    """Return the names of a file's layers; call it inside :func:`gdal_faults`."""
    import pyogrio  # slow to import

    return [str(layer[0]) for layer in pyogrio.list_layers(gdal_name(path))]


def layer_info(path: Path, layer: str | None = None) -> dict[str, Any]:
    """Return GDAL's information on a layer (by default the first); call it inside :func:`gdal_faults`.

    Raises
    ------
    FormatError
        if the layer is a table without geometry.
    """
    import pyogrio  # slow to import

    info = dict(pyogrio.read_info(gdal_name(path), layer=layer))
    if info["geometry_type"] is None:
        raise FormatError(f"layer '{info['layer_name']}' has no geometry", expected="a layer of features", file=path)
    return info


def chosen_layer(layers: list[str], stated: str | None, file: Path) -> str:
    """Return the name of the layer to read: the stated one, or the only one.

    Raises
    ------
    ConfigError
        if there is no such layer, or if there are several and none is stated.
    """
    if stated is not None and stated not in layers:
        raise ConfigError(
            f"there is no layer '{stated}'{nearest(stated, layers)}",
            expected="one of: " + ", ".join(layers),
            file=file,
        )
    if stated is None and len(layers) != 1:
        raise ConfigError(
            f"the file has {len(layers)} layers",
            file=file,
            missing=Missing("options.layer", choices=tuple(layers)),
        )
    return stated or layers[0]


def feature_batches(
    path: Path, layer: str, expected: str = "GeoJSON or GeoPackage points", **asked: Any
) -> Iterator[pa.RecordBatch]:
    """Yield the features of a layer with their geometry as WKB; `asked` is passed to GDAL."""
    import pyogrio  # slow to import

    with ExitStack() as stack:
        with gdal_faults(path, expected):
            opened = pyogrio.open_arrow(
                gdal_name(path), layer=layer, batch_size=BATCH_FEATURES, use_pyarrow=True, **asked
            )
            reader = stack.enter_context(opened)[1]
            names = reader.schema.names  # refuses names that are no text
            if len(set(names)) < len(names):
                raise FormatError("two attributes have the same name", expected=expected, file=path)
        while True:
            with gdal_faults(path, expected):
                batch = next(reader, None)
            if batch is None:
                return
            yield batch


def shapes_of(batch: pa.RecordBatch, geometry: str) -> npt.NDArray[np.object_]:
    """Return geometries (n,) of features, None where invalid; `geometry` names their column, "" the default."""
    name = geometry if geometry and geometry in batch.schema.names else "wkb_geometry"
    with np.errstate(invalid="ignore"):  # coordinates that are no numbers
        shapes = shapely.from_wkb(batch.column(name).to_numpy(zero_copy_only=False), on_invalid="ignore")
    return np.asarray(shapes, dtype=object)


def check_archive(path: Path) -> None:
    """Refuse a ZIP archive with a member whose checksum is wrong, because GDAL does not check it.

    Raises
    ------
    FormatError
        if it is damaged.
    """
    if path.suffix.lower() != ".zip":
        return
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, NotImplementedError, ValueError) as error:
        raise FormatError(f"the archive is damaged: {error}", change="fetch it again", file=path) from error
    if damaged is not None:
        raise FormatError(f"the archive's member '{damaged}' is damaged", change="fetch it again", file=path)


def unread_features(path: Path, read: int) -> Iterator[Reject]:
    """Yield a reject for features that a file lists and GDAL silently skipped.

    GDAL leaves out members of a GeoJSON file whose type is not "Feature" (only files up to 16 MB are looked at), and
    features of a shapefile that its attribute table does not count or marks as deleted.
    """
    listed = _listed_features(path)
    if listed > read:
        yield Reject("the file lists features that cannot be read", records=listed - read)


def _listed_features(path: Path) -> int:
    try:
        if path.suffix.lower() == ".zip":
            with zipfile.ZipFile(path) as archive:
                sizes = [m.file_size for m in archive.infolist() if m.filename.lower().endswith(".shx")]
            return _shx_features(sizes[0]) if len(sizes) == 1 else 0
        if path.suffix.lower() == ".shp":
            return _shx_features(path.with_suffix(".shx").stat().st_size)
        if path.stat().st_size > _LARGEST_JSON:
            return 0
        data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
        if not data.lstrip().startswith(b"{"):
            return 0
        features = json.loads(data.decode("utf-8", errors="replace"), strict=False).get("features")
    except (OSError, ValueError, AttributeError, RecursionError, zipfile.BadZipFile):
        return 0
    return len(features) if isinstance(features, list) else 0


def _shx_features(size: int) -> int:
    """Return the features in a shapefile's index: 8 bytes each after 100."""
    return max(0, size - 100) // 8


def flat_crs(crs: pyproj.CRS) -> pyproj.CRS:
    """Return the horizontal part of a CRS."""
    horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
    return horizontal.to_2d() if horizontal.is_geographic or horizontal.is_projected else horizontal


def attribute_values(batch: pa.RecordBatch, name: str) -> list[Any]:
    """Return the values of an attribute; text as bytes, because GDAL does not check that it is UTF-8.

    Raises
    ------
    FormatError
        if GDAL lists the attribute and does not hand it out, as with some damaged names.
    """
    if name not in batch.schema.names:
        raise FormatError(f"the attribute '{name}' cannot be read", expected="one attribute of each name")
    column = batch.column(name)
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        column = column.cast(pa.large_binary())
    values: list[Any] = column.to_pylist()
    return values


def word_of(value: Any) -> str:
    """Return the text of an attribute, "" where missing; U+FFFD replaces bytes that are no text."""
    if value is None:
        return ""
    return (value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)).strip()


def number_of(value: Any) -> float:
    """Return the number of an attribute, NaN where it is missing or none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")
