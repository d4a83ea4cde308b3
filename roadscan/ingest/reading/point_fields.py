"""Names of the fields of point clouds, as drivers and programs write them."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Final

from roadscan.core.errors import ConfigError, nearest

AXES: Final = ("x", "y", "z")
INTENSITIES: Final = ("intensity", "intensities", "reflectivity", "signal")
"""Names of a field with the intensity."""
LASERS: Final = ("ring", "channel", "line", "laser_id", "laser")
"""Names of a field with the laser's number."""


def field_named(
    stated: str | None, option: str, usual: tuple[str, ...], names: Collection[str], file: Path
) -> str | None:
    """Return a field's name, as stated or one of the usual ones; None where there is none.

    Raises
    ------
    ConfigError
        where the stated one is not there.
    """
    if stated is None:
        return next((name for name in usual if name in names), None)
    if stated not in names:
        raise ConfigError(
            f"options.{option} = '{stated}'{nearest(stated, names)}: the points have no such field",
            expected="one of: " + ", ".join(names),
            file=file,
        )
    return stated
