"""Converts points measured in pictures to rows of the table `picture_points`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import FormatError, nearest
from roadscan.formats.vectors.control import BY_HAND, FOUND
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows
from roadscan.ingest.reading.records import NO_TEXT, Sieve, options_of
from roadscan.ingest.reading.text_table import (
    Kind,
    TextBlock,
    TextLayout,
    TextOptions,
    sniff_layout,
    text_blocks,
    text_layout,
)

TABLE: Final = "picture_points"
_FARTHEST_PX: Final = 200_000.0  # places farther from a picture's corner count as damage (pixels)
_LARGEST_SIGMA_PX: Final = 1_000.0  # larger σ count as damage (pixels)


@dataclass(frozen=True)
class RawPoints:
    """n measurements as a file has them."""

    records: Int64
    offsets: Int64
    """−1 where there is none."""
    runs: Sequence[str | None]
    sensors: Sequence[str | None]
    pictures: Sequence[str]
    points: Sequence[str]
    uv_px: Float64
    """(2, n) from the centre of the upper left pixel."""
    sigma_px: Float64
    """(n,) NaN: not stated."""
    sources: Sequence[str]


def point_items(raw: RawPoints) -> Iterator[Item]:
    """Yield rows of the sound measurements, and rejects of the others."""
    sieve = Sieve(raw.records.size)
    names = list(zip(raw.pictures, raw.points, strict=True))
    sieve.drop(np.array([not picture for picture, _ in names], bool), "the picture has no name")
    sieve.drop(np.array([not point for _, point in names], bool), "the point has no name")
    texts = zip(raw.runs, raw.sensors, names, strict=True)
    sieve.drop(np.array([NO_TEXT in f"{run}{sensor}{name}" for run, sensor, name in texts], bool), "a name is no text")
    sieve.require("u_px", raw.uv_px[0], -_FARTHEST_PX, _FARTHEST_PX, "px")
    sieve.require("v_px", raw.uv_px[1], -_FARTHEST_PX, _FARTHEST_PX, "px")
    stated = ~np.isnan(raw.sigma_px)
    outside = stated & ~((raw.sigma_px > 0.0) & (raw.sigma_px <= _LARGEST_SIGMA_PX))
    sieve.drop(outside, f"sigma_px is not above 0 and at most {_LARGEST_SIGMA_PX:g} px")
    sieve.drop(np.array([one not in (BY_HAND, FOUND) for one in raw.sources], bool), "source is neither of its words")
    yield from sieve.rejects(raw.records, raw.offsets)
    rows = np.flatnonzero(sieve.good)
    if not rows.size:
        return

    def chosen(values: Sequence[Any]) -> list[Any]:
        return [values[i] for i in rows.tolist()]

    columns = {
        "run": pa.array(chosen(raw.runs), pa.string()),
        "sensor": pa.array(chosen(raw.sensors), pa.string()),
        "picture": pa.array(chosen(raw.pictures), pa.string()),
        "point": pa.array(chosen(raw.points), pa.string()),
        "u_px": pa.array(raw.uv_px[0, rows]),
        "v_px": pa.array(raw.uv_px[1, rows]),
        "sigma_px": pa.array(raw.sigma_px[rows], mask=~stated[rows]),
        "source": pa.array(chosen(raw.sources), pa.string()),
    }
    yield Rows(TABLE, pa.RecordBatch.from_pydict(columns), records=raw.records[rows])


_NEEDED: Final = ("picture", "point", "u_px", "v_px")
_WORDS: Final = ("picture", "point", "run", "sensor", "source")
_KNOWN: Final = (*_NEEDED, "run", "sensor", "sigma_px", "source")


class PicturePointsCsvOptions(TextOptions):
    """Settings of `picture_points_csv`."""


class PicturePointsCsv(LogFormat):
    """A line a measurement: picture, point, u_px, v_px; and run, sensor, sigma_px, source where they are known.

    `picture` is the file as the table `images` names it, `point` the name of a control point, or any name of a point
    without a position. Pixels count from the centre of the upper left one, to the right and down. `source` is `by hand`
    (where left out) or `found`. `roadscan camera targets` writes such files, and `roadscan camera resect` reads them.
    """

    name = "picture_points_csv"
    title = "Points measured in pictures as CSV (picture, point, u_px, v_px, σ)"
    yields = ("picture_points",)
    time = "holds no time"
    options = PicturePointsCsvOptions

    def sniff(self, path: Path) -> bool:
        """True if the columns are there by name."""
        layout = sniff_layout(path)
        return layout is not None and set(_NEEDED) <= set(layout.names)

    def header(self, source: LogSource) -> LogHeader:
        """Check the columns."""
        layout = _layout(source)
        return LogHeader({"columns": [name for name in _KNOWN if name in layout.names]})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream measurements; a line without a picture, a point or a place is rejected."""
        layout = _layout(source)
        kinds: dict[str, Kind] = {
            name: "text" if name in _WORDS else "number" for name in _KNOWN if name in layout.names
        }
        for block in text_blocks(source.path, layout, kinds):
            if isinstance(block, Reject):
                yield block
            else:
                yield from point_items(_raw(block))


def _layout(source: LogSource) -> TextLayout:
    """Return the layout of a file that has the columns.

    Raises
    ------
    FormatError
        where one is missing.
    """
    source.need_file()
    layout = text_layout(source.path, options_of(source, PicturePointsCsvOptions))
    missing = [name for name in _NEEDED if name not in layout.names]
    if missing:
        raise FormatError(
            f"there is no column {missing[0]}{nearest(missing[0], layout.names)}",
            expected="columns " + ", ".join(_NEEDED) + "; and run, sensor, sigma_px, source where they are known",
            change="name the column so, or state options.names",
            file=source.path,
        )
    return layout


def _raw(block: TextBlock) -> RawPoints:
    """Return the measurements of a block."""
    count = block.records.size

    def words(name: str, otherwise: str | None) -> list[str | None]:
        if name not in block.columns:
            return [otherwise] * count
        return [word or otherwise for word in block.text(name)]

    missing = np.full(count, np.nan)
    return RawPoints(
        block.records, block.offsets, words("run", None), words("sensor", None),
        [word or "" for word in words("picture", "")], [word or "" for word in words("point", "")],
        np.stack([block.number("u_px"), block.number("v_px")]),
        block.number("sigma_px") if "sigma_px" in block.columns else missing,
        [word or BY_HAND for word in words("source", BY_HAND)],
    )  # fmt: skip
