"""The contents of a report section: paragraphs, tables, pictures and drawings of the map.

All text is escaped by the template: names and messages come from logs and survey files.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final, Self

import numpy as np

from roadscan.compute.array_types import Float64

MOST_ROWS: Final = 60
"""Most rows of a table, where it states no other number: a longer one is cut, and says so."""


@dataclass(frozen=True)
class Paragraph:
    """A sentence or more."""

    kind: ClassVar[str] = "paragraph"
    text: str
    is_warning: bool = False


@dataclass(frozen=True)
class Table:
    """A table of texts; columns after the first are numbers where `numbers` says so."""

    kind: ClassVar[str] = "table"
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    full_table: str = ""
    """Name of the SQL table with all rows, where the page may show only some of them."""
    numbers: bool = True
    most_rows: int = MOST_ROWS
    """Most rows that the page shows."""

    @property
    def shown(self) -> Sequence[Sequence[str]]:
        """Rows that the page shows."""
        return self.rows[: self.most_rows]

    @property
    def left_out(self) -> int:
        """Number of rows that it does not show."""
        return max(len(self.rows) - self.most_rows, 0)


@dataclass(frozen=True)
class Picture:
    """A picture that is embedded in the page."""

    kind: ClassVar[str] = "picture"
    content: bytes
    """PNG or JPEG."""
    caption: str
    width_mm: float = 170.0
    """Largest width on paper."""
    link: str = ""
    """Its link in the page of a published site: the part of the address after the page's name, from ``#`` on."""

    @property
    def address(self) -> str:
        """The picture as a data URL."""
        kind = "jpeg" if self.content[:2] == b"\xff\xd8" else "png"
        return f"data:image/{kind};base64,{base64.b64encode(self.content).decode('ascii')}"


@dataclass(frozen=True)
class Line:
    """A line of a map."""

    points: str
    """Pairs of coordinates as SVG writes them."""
    colour: str


@dataclass(frozen=True)
class Drawing:
    """A map as vector graphics; easting to the right, northing up."""

    kind: ClassVar[str] = "drawing"
    width: float
    height: float
    lines: Sequence[Line]
    squares: Sequence[tuple[float, float, float, str]] = ()
    """Left, top, edge and colour of squares behind the lines."""
    marks: Sequence[tuple[float, float, str, str]] = ()
    """Left, top, text and colour of named marks."""
    scale_bar: tuple[float, str] = (0.0, "")
    """Length in the units of the drawing, and its text."""
    legend: Sequence[tuple[str, str]] = ()
    """Colour and text."""
    caption: str = ""


Block = Paragraph | Table | Picture | Drawing


@dataclass(frozen=True)
class Part:
    """A section as the page shows it."""

    name: str
    title: str
    blocks: Sequence[Block] = field(default_factory=tuple)


COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
"""Colours that people with any colour vision can distinguish (Okabe and Ito 2008)."""
WIDTH: Final = 1000.0  # width of a drawing, in its units
_MARGIN: Final = 40.0  # margin of a drawing
_HIGHEST: Final = 900.0  # greatest height of a drawing
_LEAST_EXTENT_M: Final = 1.0  # least extent that is shown


@dataclass(frozen=True)
class MapPage:
    """A drawing of a piece of the map, north up, `WIDTH` wide."""

    low_m: Float64
    """(2,) easting and northing of the piece's south-western corner."""
    extent_m: Float64
    """Width and height of the piece (2,)."""
    scale: float
    """Units of the drawing per metre."""

    @classmethod
    def around(cls, places_m: Float64) -> Self:
        """Return a drawing that contains all places (n, 2) of the map."""
        low = places_m.min(axis=0)
        extent = np.maximum(places_m.max(axis=0) - low, _LEAST_EXTENT_M)
        scale = min((WIDTH - 2 * _MARGIN) / extent[0], (_HIGHEST - 2 * _MARGIN) / extent[1])
        return cls(low, extent, float(scale))

    @property
    def height(self) -> float:
        """Height of the drawing."""
        return float(self.extent_m[1] * self.scale + 2 * _MARGIN)

    @property
    def scale_bar(self) -> tuple[float, str]:
        """Return the length of a bar of 1, 10, 100 … metres, and its text."""
        bar_m = 10.0 ** math.floor(math.log10(max(float(self.extent_m.max()) / 4, 1.0)))
        return bar_m * self.scale, f"{bar_m / 1000:g} km" if bar_m >= 1000 else f"{bar_m:g} m"

    def on_page(self, places_m: Float64) -> Float64:
        """Return places (n, 2) of the drawing, downwards positive, of places (n, 2) of the map."""
        x = _MARGIN + (places_m[:, 0] - self.low_m[0]) * self.scale
        y = self.height - _MARGIN - (places_m[:, 1] - self.low_m[1]) * self.scale
        return np.stack([x, y], axis=-1)
