"""Pictures that a site shows: those of cameras with a pose, and cut-outs of assets."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from roadscan.assets.tasks.picture_work import CUT_OUTS
from roadscan.core.errors import DamagedError, RoadscanError
from roadscan.core.grid import Bounds
from roadscan.pictures.placed import Pictures as PlacedPictures
from roadscan.pictures.placed import plan_pictures
from roadscan.pictures.views import PictureRule
from roadscan.privacy.hider import Hider, hider_of
from roadscan.site.material import Material
from roadscan.store.manifest import OutputRecord

_RULE: Final = PictureRule((), 30.0, 0.0, 1)
"""Selects all cameras with an interior orientation."""
SHOWN_AS_THEY_ARE: Final = {".jpg": ".jpg", ".jpeg": ".jpg", ".png": ".png", ".webp": ".webp"}
"""Formats that browsers show, with the suffix in the site."""


@functools.lru_cache(maxsize=2)
def placed_pictures(material: Material) -> PlacedPictures | None:
    """Return pictures with poses; None where there are none, or none are requested or may be published."""
    if not material.wishes.pictures or material.privacy == "unstated":
        return None
    try:
        held = plan_pictures(material.plan, _RULE)
    except DamagedError:
        raise
    except RoadscanError:
        return None  # no camera, interior orientation or picture with a pose: the page goes without
    near = material.wishes.near
    if near is not None:
        held = held.near(Bounds(*near))
    return held if any(held.path(number).is_file() for number in range(len(held))) else None


def has_pictures(material: Material) -> bool:
    """Return True where the survey has pictures with poses, whether or not they may be published."""
    stated = replace(material, wishes=replace(material.wishes, stays_here=True))
    return placed_pictures(stated) is not None


def hider_for(material: Material) -> Hider | None:
    """Return what hides people and vehicles in pictures; None where nothing is hidden.

    Raises
    ------
    ConfigError
        where they are to be hidden and nothing says where they are.
    """
    return hider_of(material.session) if material.privacy == "blur" else None


def picture_url(material: Material, held: PlacedPictures, number: int) -> str:
    """Return the path of a picture in the site; pictures in which something may be hidden are JPEG."""
    known = SHOWN_AS_THEY_ARE if material.privacy != "blur" else {}
    suffix = known.get(held.path(number).suffix.lower(), ".jpg")
    return f"pictures/{int(held.log[number])}/{number:06d}{suffix}"


@functools.lru_cache(maxsize=2)
def picture_urls(material: Material) -> Mapping[tuple[str, str, str], str]:
    """Return the path of each picture in the site, by run, camera and file."""
    placed = placed_pictures(material)
    logs = () if placed is None else (placed.logs[number] for number in placed.log.tolist())
    return {
        (log.run, log.sensor, placed.files[k]): picture_url(material, placed, k)
        for k, log in enumerate(logs)
        if placed is not None
    }


@functools.lru_cache(maxsize=2)
def cut_out_records(material: Material) -> Mapping[str, OutputRecord]:
    """Return records of cut-outs, by path; none where no pictures are shown.

    Where people and vehicles are hidden, cut-outs need a network: returns are known in whole pictures alone.
    """
    if placed_pictures(material) is None:
        return {}
    hider = hider_for(material)
    if hider is not None and hider.detector is None:
        return {}
    return {one.path: one for one in material.session.manifest.of(CUT_OUTS).values() if one.path}


def cut_out_url(record: OutputRecord) -> str:
    """Return the path of a cut-out in the site."""
    return f"pictures/cut_outs/{record.unit}.jpg"
