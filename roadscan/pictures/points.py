"""Points measured in pictures (table `picture_points`): those that logs state, and files of them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.csv as pa_csv

from roadscan.core.errors import ConfigError, RunError
from roadscan.core.rig import Rig
from roadscan.core.rig_text import replace_file
from roadscan.formats.vectors.control import BY_HAND, FOUND
from roadscan.navigation.tasks.recorded_pictures import taken_pictures
from roadscan.store.logs import LogRecord
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.schema import table_schema
from roadscan.store.store import Store, alone_in

POINTS: Final = "picture_points"
_CONTROL: Final = "control_points"
_CSV_DIGITS: Final = 4  # digits of pixels in a file


@dataclass(frozen=True)
class MeasuredPoints:
    """Measurements whose pictures are known, and notes on those that were left out."""

    rows: pa.Table
    """Of the table `picture_points`; run and sensor are never null."""
    notes: tuple[str, ...]


def measured_points(store: Store, records: Sequence[LogRecord], rig: Rig) -> MeasuredPoints:
    """Return the points that logs state to be measured in pictures.

    A row without a run or a sensor has those of its log, or else those of the only picture of that name. A row whose
    picture is not known, or that several pictures of one name could be meant by, is left out and noted. Of several
    places of one point in one picture the last that a person measured counts, or else the last; the others are noted.
    """
    known = _pictures(store, records, rig)
    kept: dict[tuple[str, str, str, str], dict[str, Any]] = {}
    faults: Counter[str] = Counter()
    for record in records:
        for file in record.tables.get(POINTS, ()):
            for row in read_groups(store, file.path, range(len(file.group_rows))).to_pylist():
                meant = _meant(row, record, known)
                if len(meant) != 1:
                    why = "is not in the store" if not meant else "is the name of several pictures"
                    faults[f"{record.path}: '{row['picture']}' {why}"] += 1
                    continue
                run, sensor = meant[0]
                place = run, sensor, row["picture"], row["point"]
                if place in kept:
                    faults[f"{record.path}: {row['point']} stands twice in {run}/{sensor}/{row['picture']}"] += 1
                    if row["source"] == FOUND and kept[place]["source"] == BY_HAND:
                        continue
                kept[place] = row | {"run": run, "sensor": sensor}
    ordered = [kept[place] for place in sorted(kept)]
    notes = tuple(f"{text}: {n:,} measurement{'s' * (n > 1)} left out" for text, n in sorted(faults.items()))
    return MeasuredPoints(pa.Table.from_pylist(ordered, schema=table_schema(POINTS).arrow()), notes)


def control_rows(store: Store, records: Sequence[LogRecord]) -> list[dict[str, Any]]:
    """Return the rows of the survey's control points, by name.

    Raises
    ------
    RunError
        where there are none, or two have one name.
    """
    files = [file for record in records for file in record.tables.get(_CONTROL, ())]
    rows = [row for f in files for row in read_groups(store, f.path, range(len(f.group_rows))).to_pylist()]
    if not rows:
        raise RunError(
            "no control points are in the store",
            expected="[[control]] in the survey file",
            change="state it, then `roadscan ingest`",
        )
    twice = [name for name, count in Counter(row["name"] for row in rows).items() if count > 1]
    if twice:
        raise RunError(f"two control points are called '{twice[0]}'", expected="a name of its own for each")
    return sorted(rows, key=lambda row: str(row["name"]))


def write_points(rows: pa.Table, file: Path) -> None:
    """Write measurements as a file that `picture_points_csv` and `roadscan camera resect` read, as a whole or not."""
    listed = rows.to_pylist()
    for row in listed:
        for name in ("u_px", "v_px", "sigma_px"):
            row[name] = None if row[name] is None else round(row[name], _CSV_DIGITS)
    content = pa.BufferOutputStream()
    table = pa.Table.from_pylist(listed, schema=rows.schema)
    pa_csv.write_csv(table, content, pa_csv.WriteOptions(quoting_style="needed"))
    replace_file(file, content.getvalue().to_pybytes())


def _pictures(store: Store, records: Sequence[LogRecord], rig: Rig) -> dict[str, list[tuple[str, str]]]:
    """Return run and camera of the pictures by their names."""
    known: dict[str, list[tuple[str, str]]] = {}
    for name, sensor in rig.sensors.items():
        if sensor.kind != "camera":
            continue
        for taken in taken_pictures(store, records, name):
            for file in dict.fromkeys(taken.files):
                known.setdefault(file, []).append((taken.record.run, name))
    return known


def _meant(
    row: dict[str, Any], record: LogRecord, known: dict[str, list[tuple[str, str]]]
) -> list[tuple[str, str]]:  # fmt: skip
    """Return run and camera of the pictures that a row may mean: what it states, then what its log does."""
    named = known.get(row["picture"], [])
    for run, sensor in ((row["run"], row["sensor"]), (row["run"] or record.run, row["sensor"] or record.sensor)):
        fitting = [one for one in named if run in (None, one[0]) and sensor in (None, one[1])]
        if len(fitting) == 1:
            return fitting
    stated = [one for one in named if row["run"] in (None, one[0]) and row["sensor"] in (None, one[1])]
    own = [one for one in stated if one[0] == record.run]
    return own if len(own) == 1 else stated


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
        schema = table_schema(POINTS).arrow()
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
            table = pa.Table.from_pylist(sorted(rows, key=_order), schema=table_schema(POINTS).arrow())
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
