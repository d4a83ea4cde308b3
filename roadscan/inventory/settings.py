"""Settings of the inventory of assets (``[inventory]``)."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Final

from pydantic import Field

from roadscan.core.strict import NAME_PATTERN, Strict, pattern_in_words
from roadscan.core.survey import SurveySection

_SCHEMA_NAME: Final = pattern_in_words(
    r"^[a-z_][a-z0-9_]{0,30}$", "1 to 31 small letters (a–z), digits and '_', of which the first is no digit"
)


class Matching(Strict):
    """When an object that is found is an asset that the inventory knows."""

    distance_m: float = Field(default=0.75, gt=0)
    """Distance up to which an object of the same kind is the asset, where four σ are less (m); of lines and areas the
    distance of their edges."""
    moved_m: float = Field(default=5.0, ge=0)
    """Distance up to which an object of about the same size is an asset that was moved, where that should have been
    seen at its place and was not (m)."""


class InventoryConfig(SurveySection):
    """The inventory: which one the survey belongs to, where people edit it, and how assets are known again."""

    table: ClassVar[str] = "inventory"
    meaning: ClassVar[str] = "The inventory of assets that people edit."

    store: str | None = None
    """Folder (relative to the survey file) or object-store URL of the inventory; the survey's store where it is left
    out. Surveys of several years share an inventory by naming the same store and name."""
    name: str | None = Field(default=None, pattern=NAME_PATTERN)
    """Name of the inventory; the survey's `id` where it is left out."""
    epoch: str | None = Field(default=None, pattern=NAME_PATTERN)
    """Name of this survey's epoch, such as "2026-spring"; the day of its first return where it is left out. What is
    processed again under the same name replaces what was found before."""
    home: Path = Path("inventory.gpkg")
    """GeoPackage that people edit, relative to the survey file."""
    postgis: str | None = None
    """Address of a PostGIS database in place of the GeoPackage, such as "postgresql://editor@host/assets"; the
    environment's ROADSCAN_POSTGIS comes before it. Keep passwords in the environment or in `~/.pgpass`."""
    schema_name: str = Field(default="inventory", pattern=_SCHEMA_NAME)
    """Schema of the tables in PostGIS."""
    matching: Matching = Matching()
    """How assets are known again."""
