"""The data of a survey for the parts of its site; shared results are computed once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.core.errors import ConfigError, DamagedError, nearest
from roadscan.core.grid import TileId
from roadscan.georeference.plan.plan import SurveyPlan, plan_of
from roadscan.inventory.of_survey import truth_of
from roadscan.inventory.state import State
from roadscan.privacy.settings import PrivacyConfig
from roadscan.run.keys import key_of
from roadscan.run.session import Session
from roadscan.store.asset_schema import asset_schema
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.tiles.mosaics.products import StoredTiles
from roadscan.tiles.product import ProductContext, TileSummary
from roadscan.tiles.products.geo_table import read_geo_table
from roadscan.tiles.tasks.tile_figures import summary_of
from roadscan.tiles.tasks.tile_plan import OVERVIEWS, TILE
from roadscan.tiles.tasks.wanted_products import product_context

SHEET_M: Final = 1000.0
"""Edge of a kilometre sheet."""

BESIDE_ROAD_M: Final = 20.0
"""Width that is shown beside a single requested road."""

Box = tuple[float, float, float, float]
"""Least easting and northing, greatest easting and northing (m)."""


@dataclass(frozen=True)
class Wishes:
    """Contents that a site should have."""

    clouds: bool = True
    """Point clouds."""
    pictures: bool = True
    """Pictures of cameras."""
    finest_pixel_m: float = 0.0
    """Finest pixel; finer rasters are left out."""
    near: Box | None = None
    """Only what is in this box of the map; everything where it is None."""
    edits: Literal["", "file", "post"] = ""
    """Whether people may edit assets, and the destination of their edits: a file, or the server."""
    privacy: Literal["", "blur", "off"] = ""
    """What is done with people and vehicles in pictures; as the survey file states where it is empty."""
    stays_here: bool = False
    """The site is shown on this machine alone, to those who have the pictures themselves: nothing is hidden."""


@dataclass(frozen=True)
class SiteTable:
    """Rows of a table with their shapes."""

    rows: pa.Table
    shapes_m: npt.NDArray[Any] | None
    """(n,) shapely geometries on the map; None for a table without."""


@dataclass(frozen=True, eq=False)
class Material:
    """A survey as the parts of its site need it."""

    session: Session
    wishes: Wishes = field(default_factory=Wishes)
    over: tuple[Session, ...] = ()
    """Surveys of the same roads whose strips are shown over those of this one."""

    @cached_property
    def others(self) -> tuple[Material, ...]:
        """The surveys that are shown over this one.

        Raises
        ------
        ConfigError
            where one has another map, or the name of this one.
        """
        found = tuple(Material(session, self.wishes) for session in self.over)
        known = {self.context.survey_id}
        for one in found:
            name = one.context.survey_id
            if one.context.map.wkt() != self.context.map.wkt() or one.context.map.height != self.context.map.height:
                raise ConfigError(
                    f"the survey '{name}' has another map", expected=f"that of '{self.context.survey_id}'"
                )
            if name in known:
                raise ConfigError(f"the survey '{name}' is there twice", expected="surveys with ids of their own")
            known.add(name)
        return found

    @property
    def privacy(self) -> Literal["blur", "off", "stays here", "unstated"]:
        """What is done with people and vehicles in pictures; unstated: no picture is published."""
        if self.wishes.stays_here:
            return "stays here"
        return self.wishes.privacy or PrivacyConfig.of(self.session.survey).pictures or "unstated"

    @property
    def store(self) -> Store:
        """Store of the survey."""
        return self.session.store

    @cached_property
    def plan(self) -> SurveyPlan:
        """The plan that georeferences readings."""
        return plan_of(self.session)

    @cached_property
    def context(self) -> ProductContext:
        """Context of products."""
        return product_context(self.plan)

    @cached_property
    def tiles(self) -> dict[TileId, OutputRecord]:
        """Records of all tiles with cells, by row and column."""
        found = {TileId.parse(r.unit): r for r in self.session.manifest.of(TILE).values() if r.path}
        return {t: found[t] for t in sorted(found, key=lambda t: (t.row, t.column)) if self._is_near(t)}

    @cached_property
    def summaries(self) -> dict[TileId, TileSummary]:
        """Figures of those tiles."""
        return {tile: one for tile, record in self.tiles.items() if (one := summary_of(record)) is not None}

    @cached_property
    def sheets(self) -> dict[str, tuple[TileId, ...]]:
        """Tiles of each kilometre sheet by its name; a tile is in the sheet of its south-west corner."""
        found: dict[str, list[TileId]] = {}
        for tile in self.tiles:
            box = self.context.grid.bounds(tile)
            found.setdefault(sheet_name(box.easting_min_m, box.northing_min_m), []).append(tile)
        return {name: tuple(found[name]) for name in sorted(found)}

    @cached_property
    def extent_m(self) -> Box | None:
        """Box of all tiles; None without any."""
        if not self.tiles:
            return None
        boxes = [self.context.grid.bounds(tile) for tile in self.tiles]
        return (
            min(b.easting_min_m for b in boxes), min(b.northing_min_m for b in boxes),
            max(b.easting_max_m for b in boxes), max(b.northing_max_m for b in boxes),
        )  # fmt: skip

    @cached_property
    def inventory(self) -> tuple[str, State] | None:
        """Name of the survey's inventory and its state today; None where it is empty.

        Raises
        ------
        DamagedError
            where the inventory is damaged.
        """
        held = truth_of(self.session)
        return (held.name, held.state()) if held.truth.commits else None

    @cached_property
    def tables_in_inventory(self) -> frozenset[str]:
        """Tables of distresses whose rows are in the inventory, with people's changes."""
        try:
            held = () if self.inventory is None else self.inventory[1].assets
        except DamagedError:
            held = ()
        return frozenset(asset_schema(kind).found_in for kind in held)

    def check_edits(self) -> None:
        """Raise :class:`ConfigError` where the survey has no inventory to edit."""
        if self.inventory is None:
            raise ConfigError(
                "there is nothing to be edited: the survey's inventory is empty",
                expected="an inventory, which `roadscan inventory publish` makes of what was found",
                change="run that first, or go without --edit",
            )

    def cells(self, tiles: Sequence[TileId] | None = None) -> StoredTiles:
        """Return cells and overviews of tiles, of all tiles unless some are named."""
        chosen = self.tiles if tiles is None else {t: self.tiles[t] for t in tiles if t in self.tiles}
        overviews = self.session.manifest.of(OVERVIEWS)
        own = [overviews[r.unit] for r in chosen.values() if r.unit in overviews and overviews[r.unit].key == r.key]
        return StoredTiles(self.store, list(chosen.values()), [r for r in own if r.path], self.context)

    def records(self, table: str) -> list[OutputRecord]:
        """Return records of a table's Parquet files, by path."""
        location = table_schema(table).location
        found = (r for r in self.session.manifest.all() if r.path.endswith(".parquet"))
        return sorted((r for r in found if r.path.startswith(f"{location}/")), key=lambda r: r.path)

    def table(self, name: str) -> SiteTable | None:
        """Return all rows of a stored table; None where it has no file."""
        return self.rows_of(self.records(name))

    def rows_of(self, records: Sequence[OutputRecord]) -> SiteTable | None:
        """Return the rows of some files of one table."""
        parts, shapes = [], []
        for record in records:
            content = read_recorded(self.store, record)
            rows = self.store.parse_table(content, record.path)
            if b"geo" in (rows.schema.metadata or {}):
                rows, own = read_geo_table(content, self.context)
                shapes.append(own)
            parts.append(rows.replace_schema_metadata(None))
        if not parts:
            return None
        joined = pa.concat_tables(parts, promote_options="permissive")
        return SiteTable(joined, np.concatenate(shapes) if shapes else None)

    def key(self, records: Sequence[OutputRecord], *parts: Any) -> str:
        """Return a hash of the content of files, and of everything else that determines a document."""
        return key_of([(r.unit, r.digest) for r in records], *parts)

    def _is_near(self, tile: TileId) -> bool:
        near, box = self.wishes.near, self.context.grid.bounds(tile)
        return near is None or (
            box.easting_min_m < near[2] and near[0] < box.easting_max_m
            and box.northing_min_m < near[3] and near[1] < box.northing_max_m
        )  # fmt: skip


def sheet_name(easting_m: float, northing_m: float) -> str:
    """Return the name of the kilometre sheet around a place: whole kilometres of easting and northing."""
    return f"{int(easting_m // SHEET_M)}_{int(northing_m // SHEET_M)}"


def box_of(shapes: npt.NDArray[Any]) -> list[float]:
    """Return the box of shapes (m), rounded to the hundredth of a millimetre."""
    return [round(float(v), 5) for v in shapely.total_bounds(shapes)]


def box_of_road(material: Material, road: str) -> Box:
    """Return the box of a road of the table `reference_lines`, with a margin (m).

    Raises
    ------
    ConfigError
        where the survey has no such road.
    """
    content = material.table("reference_lines")
    known = [] if content is None else [str(name) for name in content.rows.column("road").to_pylist()]
    if content is None or content.shapes_m is None or road not in known:
        raise ConfigError(
            f"there is no road '{road}'{nearest(road, known)}",
            expected=", ".join(known) or "a survey with the stage condition, which finds the roads",
            change="name a --box instead",
        )
    west, south, east, north = (float(v) for v in content.shapes_m[known.index(road)].bounds)
    return west - BESIDE_ROAD_M, south - BESIDE_ROAD_M, east + BESIDE_ROAD_M, north + BESIDE_ROAD_M


def box_from_text(text: str) -> Box:
    """Return the map box of ``WEST,SOUTH,EAST,NORTH`` (m).

    Raises
    ------
    ConfigError
        where it is none.
    """
    try:
        west, south, east, north = (float(one) for one in text.split(","))
    except ValueError:
        west = south = east = north = math.nan
    if not (west < east and south < north and math.isfinite(west + south + east + north)):
        raise ConfigError(f"the box '{text}'", expected="WEST,SOUTH,EAST,NORTH in metres, west before east")
    return west, south, east, north
