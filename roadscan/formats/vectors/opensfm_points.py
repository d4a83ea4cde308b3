"""Places of control points in pictures, of OpenSfM: the observations of ground_control_points.json."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field

from roadscan.core.errors import ConfigError, Missing
from roadscan.core.strict import Strict
from roadscan.formats.vectors.opensfm_gcp import number_of, opensfm_points
from roadscan.formats.vectors.picture_points import BY_HAND, RawPoints, point_items
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, beside
from roadscan.ingest.reading.records import options_of
from roadscan.store.codecs.image_files import ImageError, image_size

_NO_SIZE: Final = "the picture's size is not known"


class OpensfmPointsOptions(Strict):
    """Settings of `opensfm_picture_points`."""

    pictures: Path | None = None
    """Folder of the pictures, relative to the file's: places are shares of a picture's size, which is read there."""
    size_px: tuple[int, int] | None = None
    """Width and height of all pictures (pixels), in place of the folder."""
    sigma_px: float | None = Field(default=None, gt=0.0)
    """1 σ of each coordinate of all points (pixels); not stated where left out."""


class OpensfmPoints(LogFormat):
    """Where the points of OpenSfM's `points` are in pictures: the `projection` of each of their `observations`.

    Projections are places from the picture's middle, in units of the larger of its width and height. Points without a
    position, and points in one picture only, are read as well: they tie pictures together, or wait for more. The
    points' positions are read by `opensfm_gcp` from the same file, so this format has to be stated.
    """

    name = "opensfm_picture_points"
    title = "OpenSfM's places of control points in pictures (ground_control_points.json)"
    yields = ("picture_points",)
    time = "holds no time"
    options = OpensfmPointsOptions

    def sniff(self, path: Path) -> bool:
        """Never: the same file is `opensfm_gcp`, and the survey file says which part of it is meant."""
        return False

    def header(self, source: LogSource) -> LogHeader:
        """Check that sizes of pictures can be known."""
        options = options_of(source, OpensfmPointsOptions)
        source.need_file()
        opensfm_points(source.path)
        if options.pictures is None and options.size_px is None:
            raise ConfigError(
                "places are shares of the pictures' size, and nothing says where the pictures are",
                expected="options.pictures, their folder; or options.size_px",
                file=source.path,
                missing=Missing("options.pictures", "images", is_example=True),
            )
        return LogHeader({})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream measurements, point by point; one without a place or a picture's size is rejected."""
        options = options_of(source, OpensfmPointsOptions)
        sizes = _Sizes(source.path, options)
        for record, point in enumerate(opensfm_points(source.path)):
            listed = point.get("observations")
            seen = [one for one in listed if isinstance(one, dict)] if isinstance(listed, list) else []
            if not seen:
                yield Reject("the point has no observations", record)
                continue
            placed = [_place(one, sizes) for one in seen]
            unknown = sum(place is None for place in placed)
            if unknown:
                yield Reject(f"{_NO_SIZE}, of {unknown} of the point's pictures", record)
            kept = [(one, place) for one, place in zip(seen, placed, strict=True) if place is not None]
            if kept:
                yield from point_items(_raw(record, point, kept, options))


class _Sizes:
    """Sizes of pictures, read once each."""

    def __init__(self, file: Path, options: OpensfmPointsOptions) -> None:
        self._folder = None if options.pictures is None else beside(file, options.pictures)
        self._known: dict[str, tuple[int, int] | None] = {}
        self._all = options.size_px

    def of(self, name: str) -> tuple[int, int] | None:
        """Return width and height of a picture; None where they are not known."""
        if self._all is not None or self._folder is None:
            return self._all
        if name not in self._known:
            inside = Path(name).name == name and name not in {"", ".", ".."}
            try:
                size = image_size(self._folder / name) if inside else None
            except (ImageError, OSError):
                size = None
            self._known[name] = None if size is None else (size.width_px, size.height_px)
        return self._known[name]


def _place(seen: dict[str, Any], sizes: _Sizes) -> tuple[float, float] | None:
    """Return u, v (pixels) of an observation, NaN where there is none; None where the picture's size is not known."""
    size = sizes.of(str(seen.get("shot_id", "")))
    if size is None:
        return None
    listed = seen.get("projection")
    pair = listed if isinstance(listed, list) and len(listed) == 2 else [None, None]
    larger = max(size)
    u, v = (larger * number_of(value) + 0.5 * (side - 1) for value, side in zip(pair, size, strict=True))
    return u, v


def _raw(
    record: int,
    point: dict[str, Any],
    kept: list[tuple[dict[str, Any], tuple[float, float]]],
    options: OpensfmPointsOptions,
) -> RawPoints:
    """Return the measurements of one point."""
    count = len(kept)
    sigma = np.nan if options.sigma_px is None else options.sigma_px
    return RawPoints(
        np.full(count, record, np.int64), np.full(count, -1, np.int64), [None] * count, [None] * count,
        [str(one.get("shot_id", "")) for one, _ in kept], [str(point.get("id", ""))] * count,
        np.array([place for _, place in kept]).T, np.full(count, sigma), [BY_HAND] * count,
    )  # fmt: skip
