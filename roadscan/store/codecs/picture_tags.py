"""Reads what a picture's EXIF tags state of it (JEITA CP-3451): statements to confirm, which nothing uses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

_FILM_DIAGONAL_MM: Final = math.hypot(36.0, 24.0)
"""Diagonal of the 35 mm film that FocalLengthIn35mmFilm refers to (CIPA DCG-001)."""
_TURNED: Final = {3: "to be turned by 180°", 6: "to be turned by 90° clockwise", 8: "to be turned by 90° anticlockwise"}
"""How a picture becomes upright, by Orientation; 1 is upright, the others are mirrored."""
_UPRIGHT: Final = 1  # Orientation of an upright picture


def picture_tags(path: Path) -> dict[str, Any]:
    """Return what the tags of a picture state, JSON values by name; nothing of a damaged picture.

    taken (with its offset from UTC where stated), camera, focal_mm, focal_35mm_mm, focal_px (from the latter and the
    picture's diagonal), size_px, orientation (where not upright), latitude_deg, longitude_deg, altitude_m.
    """
    from PIL import ExifTags, Image

    try:
        with Image.open(path) as image:
            tags = image.getexif()
            shot, place = tags.get_ifd(ExifTags.IFD.Exif), tags.get_ifd(ExifTags.IFD.GPSInfo)
            base = ExifTags.Base
            taken = _text(shot.get(base.DateTimeOriginal)) or _text(tags.get(base.DateTime))
            film_mm = _number(shot.get(base.FocalLengthIn35mmFilm))
            orientation = _number(tags.get(base.Orientation)) or _UPRIGHT
            found = {
                "taken": " ".join(filter(None, (taken, _text(shot.get(base.OffsetTimeOriginal))))),
                "camera": " ".join(filter(None, (_text(tags.get(base.Make)), _text(tags.get(base.Model))))),
                "focal_mm": _number(shot.get(base.FocalLength)),
                "focal_35mm_mm": film_mm,
                "focal_px": None if not film_mm else round(film_mm / _FILM_DIAGONAL_MM * math.hypot(*image.size), 1),
                "size_px": list(image.size),
                "orientation": "" if orientation == _UPRIGHT else _TURNED.get(int(orientation), "mirrored"),
                "latitude_deg": _degrees(place, ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "S"),
                "longitude_deg": _degrees(place, ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "W"),
                "altitude_m": _number(place.get(ExifTags.GPS.GPSAltitude)),
            }
    except Exception:  # noqa: BLE001 — Pillow raises anything on damaged bytes
        return {}
    stated = {name: value for name, value in found.items() if value not in (None, "")}
    return stated if stated.keys() - {"size_px"} else {}


def tags_in_words(tags: Mapping[str, Any]) -> str:
    """Return what :func:`picture_tags` found as a list of words; "" for nothing."""
    parts = [
        ("taken", "taken {taken} on the camera's own clock"),
        ("camera", "{camera}"),
        ("focal_mm", "focal length {focal_mm:g} mm"),
        ("focal_px", "{focal_px:g} pixels by its equivalent of {focal_35mm_mm:g} mm film"),
        ("orientation", "{orientation}"),
        ("latitude_deg", "at {latitude_deg:.6f}°, {longitude_deg:.6f}°"),
        ("altitude_m", "{altitude_m:g} m high"),
    ]
    known = [words for name, words in parts if name in tags and (name != "latitude_deg" or "longitude_deg" in tags)]
    return ", ".join(words.format(**tags) for words in known)


def _text(value: Any) -> str:
    return str(value).strip(" \0") if isinstance(value, str) else ""


def _number(value: Any) -> float | None:
    """Return a finite number, None for anything else: a denominator may be 0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _degrees(place: Mapping[int, Any], tag: int, reference: int, negative: str) -> float | None:
    """Return an angle of three rational numbers (degrees, minutes, seconds), None where it is none."""
    values = place.get(tag)
    parts = [_number(value) for value in values] if isinstance(values, tuple) and len(values) == 3 else [None]
    if any(part is None for part in parts):
        return None
    degrees, minutes, seconds = (part or 0.0 for part in parts)
    angle = degrees + minutes / 60 + seconds / 3600
    return -angle if _text(place.get(reference)) == negative else angle
