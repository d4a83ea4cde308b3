"""A file of control points that people measured in pictures, one by one; each is on the disk before the next."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.csv as pa_csv

from roadscan.core.errors import ConfigError
from roadscan.formats.vectors.picture_points import BY_HAND
from roadscan.pictures.points import TABLE, write_points
from roadscan.store.schema import table_schema
from roadscan.store.store import alone_in

FILE: Final = "control_in_pictures.csv"
"""Name of the file beside the survey file."""
_SAME_PX: Final = 1e-3
"""Pixels that differ by less are one: the file has four digits."""

Place = tuple[str, str, str, str]
"""Run, sensor, picture and point of a measurement."""


@dataclass(frozen=True)
class ClickedPoints:
    """The file, whose measurements are put in and taken out one by one; several windows and programs may do so."""

    file: Path
    _alone: threading.Lock = field(default_factory=threading.Lock)

    def rows(self) -> list[dict[str, Any]]:
        """Return the measurements, by point and picture; none where there is no file yet.

        Raises
        ------
        ConfigError
            where the file has other columns, or values that are none.
        """
        schema = table_schema(TABLE).arrow()
        if not self.file.exists():
            return []
        options = pa_csv.ConvertOptions(column_types=schema, strings_can_be_null=True, null_values=[""])
        try:
            read = pa_csv.read_csv(self.file, convert_options=options)
            rows = read.select(schema.names).cast(schema).to_pylist()
        except (pa.ArrowException, KeyError, OSError) as error:
            raise ConfigError(
                f"the measurements cannot be read: {error}",
                expected="columns " + ", ".join(schema.names) + ", as the page wrote them",
                change="mend the file, or give it another name: it is not touched before that",
                file=self.file,
            ) from error
        return sorted(rows, key=_order)

    def put(self, place: Place, pixel: Sequence[float] | None, before: Sequence[float] | None) -> list[dict[str, Any]]:
        """Write the pixel of a point in a picture, or remove it (None), and return all measurements.

        before : the pixel that stood there to the knowledge of who asks; None for none.

        Raises
        ------
        ConfigError
            where another one stands there, since somebody else measured it meanwhile; the file stays as it is.
        """
        with self._alone, alone_in(self.file.parent):
            rows = self.rows()
            held = next((row for row in rows if _place(row) == place), None)
            there = None if held is None else (held["u_px"], held["v_px"])
            if not _same(there, before):
                told = "removed" if there is None else f"measured at {there[0]:.2f} {there[1]:.2f}"
                raise ConfigError(
                    f"{place[3]} in {place[2]} was {told} in another window meanwhile",
                    expected="what stands in the file now, which this window shows from now on", file=self.file,
                )  # fmt: skip
            rows = [row for row in rows if row is not held]
            if pixel is not None:
                run, sensor, picture, point = place
                rows.append(
                    {"run": run, "sensor": sensor, "picture": picture, "point": point, "u_px": float(pixel[0]),
                     "v_px": float(pixel[1]), "sigma_px": None, "source": BY_HAND}
                )  # fmt: skip
            table = pa.Table.from_pylist(sorted(rows, key=_order), schema=table_schema(TABLE).arrow())
            write_points(table, self.file)
            return self.rows()


def _place(row: dict[str, Any]) -> Place:
    return row["run"], row["sensor"], row["picture"], row["point"]


def _order(row: dict[str, Any]) -> tuple[str, str, str, str]:
    return row["point"], row["run"] or "", row["sensor"] or "", row["picture"]


def _same(one: Sequence[float] | None, other: Sequence[float] | None) -> bool:
    if one is None or other is None:
        return one is other
    return max(abs(a - b) for a, b in zip(one, other, strict=True)) < _SAME_PX
