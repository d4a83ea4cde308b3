"""The contract of a kind of assets, and the registry that finds kinds automatically.

A kind is one file of `roadscan/assets/kinds/` (or an entry point of the group ``roadscan.asset_kinds``) with a subclass
of :class:`AssetKind`, and one file `schemas/assets/<name>.toml` with its columns. Evidence is found tile by tile;
pieces of all tiles are joined to objects, so that nothing is fitted in one tile and cut at its border.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Self

import pyarrow as pa
import shapely
from pydantic import model_validator

from roadscan.assets.scene import Scene
from roadscan.core.plugins import found_kinds
from roadscan.core.strict import Strict

ENTRY_POINT_GROUP: Final = "roadscan.asset_kinds"


class NoOptions(Strict):
    """A kind without settings."""


class KindOptions(Strict):
    """Settings of a kind: what is named least or lowest may not exceed what is named greatest or highest."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        values = self.model_dump()
        for name, value in values.items():
            other = name.replace("least_", "greatest_").replace("lowest_", "highest_")
            if other != name and other in values and value > values[other]:
                raise ValueError(f"{name} = {value:g} is more than {other} = {values[other]:g}")
        return self


@dataclass(frozen=True, eq=False)
class Marked:
    """Returns that belong to pieces of a kind, for the classes of the LAS product."""

    rows: Any
    """Rows of the scene's returns."""
    code: int
    """Class of :mod:`roadscan.assets.classes`."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of a kind in a tile."""

    pieces: pa.Table
    """A row a piece, columns as the kind's `piece_schema`; coordinates are those of the map (easting, northing)."""
    marked: tuple[Marked, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    """Counts that the record of the evidence stores beside the number of pieces."""


@dataclass(frozen=True, eq=False)
class AssetObject:
    """An asset as it was found. Coordinates are easting, northing and height of the map frame (m)."""

    geometry: shapely.Geometry
    """Point, line or polygon with heights."""
    sigma_horizontal_m: float
    sigma_height_m: float
    probability: float
    """Probability that it is an asset of this kind: of objects with 0.9, nine of ten are."""
    returns: int
    passes: int
    first_epoch_gps_ns: int
    last_epoch_gps_ns: int
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """Values of the kind's own columns; a missing one is unknown."""
    sigma_size_m: float | None = None
    """Of what the kind measures of its size: a diameter, a width, a step or a height."""


class AssetKind(ABC):
    """A kind of assets: its evidence in a tile, and the joining of pieces of all tiles to objects."""

    name: ClassVar[str]
    """Name of its table and its schema, such as `pole`."""
    title: ClassVar[str]
    curve: ClassVar[str] = ""
    """Curve of :mod:`roadscan.assets.calibration` for its probabilities; empty: none."""
    options: ClassVar[type[Strict]] = NoOptions
    after: ClassVar[Sequence[str]] = ()
    """Kinds whose objects this one uses when it joins."""
    piece_schema: ClassVar[pa.Schema]
    reach_m: ClassVar[float] = 8.0
    """What lies farther from a square than this (m) does not change the kind's evidence in it: 8 m holds a vehicle, a
    crown, a crosswalk, a fence's least length, and the surface behind a kerb with its slope."""

    @abstractmethod
    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns pieces of this kind in the scene's tile, a pure function of the scene."""

    @abstractmethod
    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Returns objects of the pieces of all tiles, in an order that depends on the objects alone.

        `pieces` come in the order of tiles (row, column); `others` holds the objects of the kinds named by `after`.
        """


@functools.cache
def asset_kinds() -> dict[str, AssetKind]:
    """Returns all kinds by name."""
    found = found_kinds("assets/kinds/*.py", AssetKind, ENTRY_POINT_GROUP)
    return {name: kind() for name, kind in found.items()}
