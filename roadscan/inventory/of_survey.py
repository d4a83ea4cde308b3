"""The inventory of a survey: its store, its home, and the assets and distresses that were found."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa

from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.evidence import VISIBILITY
from roadscan.assets.tasks.plan import asset_grid
from roadscan.core.crs import crs_from_text
from roadscan.core.grid import TileId
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import plan_of
from roadscan.inventory.found_distresses import SeenByCells, Unknown, Visibility, VisibilityOfSquares, found_distresses
from roadscan.inventory.home import Home, HomeError
from roadscan.inventory.homes.geopackage import GeoPackage
from roadscan.inventory.homes.page_edits import PageDocument
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.qgis import Raster
from roadscan.inventory.recording import Found, Rules
from roadscan.inventory.settings import InventoryConfig
from roadscan.run.session import Session
from roadscan.store.asset_schema import asset_kind_names, asset_schema
from roadscan.store.asset_truth import COMMITS, AssetTruth
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import read_recorded, recorded_table
from roadscan.store.store import Store

FOUND: Final = "products/assets"
"""Folder of the tables of found assets, one a kind."""
ADDRESS: Final = "ROADSCAN_POSTGIS"
_BEHIND: Final = ("hillshade", "mosaic", "bare_earth")
"""Products shown behind the assets in QGIS, the uppermost first."""


def open_inventory(session: Session) -> Inventory:
    """Returns the inventory to which a survey belongs.

    Raises
    ------
    ConfigError
        where PostGIS is asked for and its driver is missing.
    """
    return _opened(session, home_of(session))


def truth_of(session: Session) -> Inventory:
    """Returns the same read-only: its home is a file that is not opened."""
    return _opened(session, GeoPackage(Path("inventory.gpkg"), None))


def commits_of(session: Session) -> list[str]:
    """Returns the files of the inventory's commits, each of which is written once."""
    return _truth(session.survey).store.files(COMMITS)


def _opened(session: Session, home: Home) -> Inventory:
    settings, survey = InventoryConfig.of(session.survey), session.survey
    name = settings.name or survey.config.id
    frame = survey.frame()
    rules = Rules(SeenByCells(session, _visibility(session)), settings.matching, frame.horizontal_unit_m)
    return Inventory(
        _truth(survey), home, name, rules, lambda: found_assets(session), frame.crs,
        lambda folder: _rasters(session, folder),
    )  # fmt: skip


def _truth(survey: Survey) -> AssetTruth:
    """Returns the commits of the inventory to which a survey belongs."""
    settings, url = InventoryConfig.of(survey), survey.store_url
    if settings.store is not None:
        url = settings.store if "://" in settings.store else str(survey.resolve(Path(settings.store)))
    frame = survey.frame()
    return AssetTruth(Store(url, settings.name or survey.config.id), (frame.horizontal_unit_m, frame.vertical_unit_m))


def inventory_faults(survey: Survey) -> list[str]:
    """Returns the faults in the files of a survey's inventory, each of which is read."""
    return _truth(survey).faults()


def home_of(session: Session, given: str | None = None) -> Home:
    """Returns the home that the survey file states, or another one: a GeoPackage or an address of PostGIS."""
    settings, survey = InventoryConfig.of(session.survey), session.survey
    frame = survey.frame()
    crs = frame.crs
    address = given if given is not None else os.environ.get(ADDRESS) or settings.postgis
    if address is not None and (given is None or "://" in given):
        from roadscan.inventory.homes.postgis import PostGis

        srid = None if crs is None else crs_from_text(crs).to_epsg()
        home = survey.resolve(settings.home)
        project = home.with_name(f"{home.stem}-postgis.qgs")
        return PostGis(address, settings.schema_name, srid, project=project, frame=frame)
    return GeoPackage(Path(given) if given is not None else survey.resolve(settings.home), crs, frame=frame)


def page_document(session: Session, name: str, content: bytes) -> PageDocument:
    """Returns edits of the page of a survey.

    Raises
    ------
    HomeError
        where `content` is no such document.
    """
    frame = session.survey.frame()
    units_m = frame.horizontal_unit_m, frame.horizontal_unit_m, frame.vertical_unit_m
    return PageDocument.parse(name, content, units_m)


def edits_of_file(file: Path) -> bytes:
    """Returns the content of a file that the page of a survey saved.

    Raises
    ------
    HomeError
        where it cannot be read.
    """
    try:
        return file.read_bytes()
    except OSError as error:
        raise HomeError(f"the edits cannot be read: {error.strerror}", file=file) from error


def found_assets(session: Session) -> Found | None:
    """Returns what the newest run found; None before there is a table of assets or distresses."""
    store = session.store
    tables: dict[str, pa.Table] = {}
    digests: list[str] = []
    records = {record.path: record for record in session.manifest.all()}
    for kind in asset_kind_names():
        file = f"{FOUND}/{asset_schema(kind).table}.parquet"
        record = records.get(file)
        if record is None and not store.exists(file):  # one that was recorded and is gone is named as missing
            continue
        content = store.read_bytes(file) if record is None else read_recorded(store, record)
        tables[kind] = store.parse_table(content, file)
        digests.append(f"{kind}:{bytes_digest(content)}")
    for one in found_distresses(session):
        tables[one.kind] = one.rows
        digests += [f"{one.kind}:{r.unit}:{r.digest}" for r in one.records]
    if not tables:
        return None
    key = bytes_digest("\n".join(digests).encode())
    nothing = not any(rows.num_rows for rows in tables.values())
    began = min((p.start_gps_ns for p in plan_of(session).passes), default=0) if nothing else 0
    return Found(tables, key, f"survey {session.survey.config.id}", InventoryConfig.of(session.survey).epoch, began)


def _visibility(session: Session) -> Visibility:
    """Returns the passes that had places in sight, as the stage `assets` recorded them, square by square."""
    config, store = AssetsConfig.stated(session.survey), session.store
    records = {} if config is None else session.manifest.of(VISIBILITY)
    if config is None or not records:
        return Unknown()

    def cells(square: TileId) -> pa.Table | None:
        record = records.get(str(square))
        return recorded_table(store, record) if record and record.path else None

    return VisibilityOfSquares(asset_grid(session.survey, config).edge_m, cells)


def _rasters(session: Session, folder: Path) -> Sequence[Raster]:
    """Returns paths of the survey's mosaics relative to a folder; none if the store is no folder."""
    if not session.store.is_folder:
        return ()
    found = []
    for product in _BEHIND:
        records = session.manifest.of(product).values()
        paths = sorted(r.path for r in records if r.path and r.path.startswith("products/") and r.path.endswith(".tif"))
        found += [
            Raster(f"{product} {Path(path).stem}", os.path.relpath(session.store.path(path), folder)) for path in paths
        ]
    return found
