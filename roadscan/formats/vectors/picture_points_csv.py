"""Points measured in pictures as text with named columns."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.core.errors import FormatError, nearest
from roadscan.formats.vectors.picture_points import BY_HAND, RawPoints, point_items
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.records import options_of
from roadscan.ingest.reading.text_table import (
    Kind,
    TextBlock,
    TextLayout,
    TextOptions,
    sniff_layout,
    text_blocks,
    text_layout,
)

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
