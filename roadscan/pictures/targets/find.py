"""Finds control targets in pictures whose poses are known within a few decimetres."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float32, Float64
from roadscan.pictures.files import read_picture
from roadscan.pictures.placed import Pictures
from roadscan.pictures.settings import PictureTargetsConfig
from roadscan.pictures.targets.aim import Aim, Eye, TargetPoint, aims
from roadscan.pictures.targets.candidates import Candidate, candidates
from roadscan.pictures.targets.fit import Fitted, best_turned, fit, is_target
from roadscan.pictures.targets.shapes import Shape
from roadscan.store.codecs.image_files import ImageError
from roadscan.store.schema import table_schema

Read: TypeAlias = Callable[[int], Float32 | None]
"""Returns the grey values (height, width) of a picture by its number; None where it cannot be read."""

TABLE: Final = "picture_points"
"""Table of points measured in pictures."""
_TRIED: Final = 4  # candidates that are fitted
_APART_PX: Final = 3.0  # finds nearer together than this are one (pixels)
_LEAST_LIKENESS: Final = 0.88  # correlation of a picture with a fitted target that counts
_LEAST_CONTRAST: Final = 25.0  # white less black of a target that counts (grey values)
_SURE: Final = 0.97  # correlation of a fitted target beside which others need no fit …
_SURELY: Final = 0.15  # … where no candidate elsewhere comes nearer than this to its own likeness
_CLEARER: Final = 0.04  # by how much the better of two finds has to be likelier to count


@dataclass(frozen=True, eq=False)
class Sought:
    """A target that may be in a picture, and what was found of it."""

    picture: int
    """Number of the picture."""
    aim: Aim
    found: Fitted | None
    reason: str
    """Why it was not found; empty where it was."""


def find_targets(
    pictures: Pictures,
    points: Sequence[TargetPoint],
    settings: PictureTargetsConfig | None = None,
    read: Read | None = None,
) -> pa.Table:
    """Return the control targets found in pictures, rows of the table `picture_points` with the source `found`.

    Parameters
    ----------
    pictures : with their stated poses and lenses; a picture that cannot be read, or is of another size than its lens
        is for, costs itself alone.
    points : control points, where they were surveyed.
    settings : how far poses may be off, and what counts as a target.
    read : gives grey values; from the pictures' files where left out.
    """
    return found_rows(pictures, seek(pictures, points, settings, read))


def found_rows(pictures: Pictures, sought: Iterable[Sought]) -> pa.Table:
    """Return the rows of the table `picture_points` of what was found, in the table's order."""
    rows = [_row(pictures, one, one.found) for one in sought if one.found is not None]
    rows.sort(key=lambda row: (str(row["point"]), str(row["picture"]), str(row["run"]), str(row["sensor"])))
    return pa.Table.from_pylist(rows, schema=table_schema(TABLE).arrow())


def seek(
    pictures: Pictures,
    points: Sequence[TargetPoint],
    settings: PictureTargetsConfig | None = None,
    read: Read | None = None,
) -> Iterator[Sought]:
    """Yield each target that may be in a picture, picture by picture, found or with the reason why not."""
    settings = settings or PictureTargetsConfig()
    places = np.array([p.place_map_m for p in points], np.float64).reshape(-1, 3)
    worlds = [pictures.map.world_from_map(world, places) for world in pictures.worlds]
    listed = list(points)
    for number in range(len(pictures)):
        eye = Eye.of(pictures.views, number)
        if eye.lens.is_around or not listed:
            continue
        aimed = list(aims(eye, worlds[pictures.views.world[number]], listed, settings))
        picture = (read or _reader(pictures))(number) if aimed else None
        if picture is not None and picture.shape != eye.size_px[::-1]:
            picture = None
        for aim in aimed:
            if picture is None:
                yield Sought(
                    number, aim, None, "the picture cannot be read, or is of another size than its lens is for"
                )
                continue
            others = np.array([one.pixel for one in aimed if one is not aim]).reshape(-1, 2)
            found, reason = _find(picture, eye, aim, others, settings)
            yield Sought(number, aim, found, reason)


def _reader(pictures: Pictures) -> Read:
    """Return what reads grey values from the pictures' files, without the rotation that a viewer would apply."""

    def read(number: int) -> Float32 | None:
        try:
            grey = read_picture(pictures.path(number), pictures.views.lens_of(number).size_px, grey=True)
        except (ImageError, OSError):
            return None
        return grey.astype(np.float32)

    return read


def _find(
    picture: Float32, eye: Eye, aim: Aim, others: Float64, settings: PictureTargetsConfig
) -> tuple[Fitted | None, str]:  # fmt: skip
    """Return the target that is aimed at, or why it was not found.

    others : (k, 2) where other targets are expected in this picture: a find nearer to one of them is that.
    """
    target = aim.point.target
    tried = _distinct(candidates(picture, eye, aim, [Shape.of(target, style) for style in target.styles]), eye)
    good: list[Fitted] = []
    reason = "nothing there looks like it"
    for candidate in tried:
        found = fit(picture, eye, candidate)
        if found is not None and candidate.shape.radii and found.likeness >= _LEAST_LIKENESS:
            found = best_turned(picture, eye, candidate, found, aim.poses)
        if found is None:
            continue
        against = _against(found, aim, others, settings)
        if against:
            reason = against if reason.startswith("nothing") else reason
            continue
        good.append(found)
        rest = [one.likeness for one in tried if _is_elsewhere(eye, one, found)]
        if found.likeness > _SURE and max(rest, default=0.0) < candidate.likeness - _SURELY:
            return found, ""
    good.sort(key=lambda one: -one.likeness)
    if not good:
        return None, reason
    best = good[0]
    rivals = [one for one in good[1:] if np.linalg.norm(one.pixel - best.pixel) > _APART_PX]
    if any(best.likeness - one.likeness < _CLEARER for one in rivals):
        return None, "two places look like it"
    return best, ""


def _is_elsewhere(eye: Eye, candidate: Candidate, found: Fitted) -> bool:
    """Return whether a candidate is another place than what was found."""
    return bool(np.linalg.norm(eye.pixels(candidate.pose.middle_m)[0] - found.pixel) > _APART_PX)


def _distinct(found: list[Candidate], eye: Eye) -> list[Candidate]:
    """Return the likeliest candidates, of those of one shape in one place the best."""
    kept: list[Candidate] = []
    for one in found:
        pixel = eye.pixels(one.pose.middle_m)[0]
        twin = any(
            other.shape.style == one.shape.style
            and np.linalg.norm(eye.pixels(other.pose.middle_m)[0] - pixel) < _APART_PX
            and abs(float(other.pose.normal @ one.pose.normal)) > 0.9
            for other in kept
        )
        if not twin:
            kept.append(one)
        if len(kept) == _TRIED:
            break
    return kept


def _against(found: Fitted, aim: Aim, others: Float64, settings: PictureTargetsConfig) -> str:
    """Return why a fitted candidate is not the target; empty where nothing speaks against it."""
    away = float(np.linalg.norm(found.pixel - aim.pixel))
    if away > aim.reach_px + _APART_PX:
        return f"what looks like it is {away:.0f} pixels from where the pose says"
    if len(others) and np.linalg.norm(others - found.pixel, axis=1).min() < away:
        return "what looks like it is nearer to another target"
    if found.contrast < _LEAST_CONTRAST:
        return f"its contrast is {found.contrast:.0f} grey values"
    return is_target(found, settings.most_sigma_px, _LEAST_LIKENESS)


def _row(pictures: Pictures, one: Sought, found: Fitted) -> dict[str, object]:
    log = pictures.logs[pictures.log[one.picture]]
    return {
        "run": log.run, "sensor": log.sensor, "picture": pictures.files[one.picture], "point": one.aim.point.name,
        "u_px": float(found.pixel[0]), "v_px": float(found.pixel[1]), "sigma_px": found.sigma_px, "source": "found",
    }  # fmt: skip
