"""Compares two surveys of a road: matches their sections, and computes the change of every quantity."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv

from roadscan.condition.comparison import VERDICTS, change_of, matched_sections
from roadscan.condition.tasks.sections import SECTIONS
from roadscan.core.errors import ConfigError, StoreError
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.store.manifest import Manifest, read_recorded
from roadscan.store.query.sql import query
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.geo_table import read_geo_table, write_geo_table
from roadscan.tiles.tasks.wanted_products import product_context

if TYPE_CHECKING:
    import pandas as pd

_KEY: Final = ["road", "lane", "station_from_m", "station_to_m"]
_VALUES: Final = (
    "SELECT road, lane, station_from_m, station_to_m, quantity, unit, value, sigma FROM condition_values"
    " WHERE extent = 'section' ORDER BY road, lane, station_from_m, quantity"
)
COLUMNS: Final = pa.schema(
    [(name, pa.string()) for name in ("road", "lane")]
    + [(name, pa.float64()) for name in ("station_from_m", "station_to_m")]
    + [(name, pa.string()) for name in ("road_before", "lane_before")]
    + [(name, pa.float64()) for name in ("station_from_before_m", "station_to_before_m", "share_in_common")]
    + [(name, pa.string()) for name in ("quantity", "unit")]
    + [(name, pa.float64()) for name in ("before", "after", "change", "sigma_change", "p_value")]
    + [("verdict", pa.string())]
)


class Changes:
    """The change of each quantity of each section that both surveys have."""

    def __init__(self, table: pa.Table, lines: npt.NDArray[Any], alone: int, context: ProductContext) -> None:
        self.table = table
        """Columns of :data:`COLUMNS`, a row a quantity of a section."""
        self.lines = lines
        """(n,) line of each row's section on the map (m)."""
        self.alone = alone
        """Sections of the later survey that have none in the earlier one."""
        self._context = context

    @property
    def changed(self) -> int:
        """Number of rows with a significant change."""
        return sum(row in ("larger", "smaller") for row in self.table["verdict"].to_pylist())

    def summary(self) -> list[tuple[str, ...]]:
        """Return for each quantity its name, the number of compared sections, and the number of each verdict."""
        counted = self.table.group_by(["quantity", "verdict"]).aggregate([([], "count_all")]).to_pylist()
        counts = {(row["quantity"], row["verdict"]): int(row["count_all"]) for row in counted}
        rows = []
        for quantity in sorted({quantity for quantity, _ in counts}):
            own = [counts.get((quantity, verdict), 0) for verdict in VERDICTS]
            rows.append((quantity, f"{sum(own):,}", *(f"{n:,}" for n in own)))
        return rows

    def write(self, file: Path) -> None:
        """Write the rows: CSV for that suffix, else GeoParquet with the sections' lines.

        Raises
        ------
        ConfigError
            for another ending.
        """
        if file.suffix == ".csv":
            pa_csv.write_csv(self.table, file)
        elif file.suffix == ".parquet":
            write_geo_table(file, self.table, "line", self.lines, ["LineString"], self._context)
        else:
            raise ConfigError(f"changes cannot be written as '{file.name}'", expected="a name with .csv or .parquet")


def compare_surveys(before: Session, after: Session) -> Changes:
    """Return changes of the condition from one survey to another of the same road.

    Raises
    ------
    ConfigError
        where their maps differ.
    StoreError
        where one has no sections.
    """
    one, other = product_context(plan_of(before)), product_context(plan_of(after))
    if one.map != other.map:
        raise ConfigError(
            f"'{before.survey.config.id}' is in {one.map.crs}, '{after.survey.config.id}' in {other.map.crs}",
            expected="two surveys in one map", change="give both survey files the same [map] and run one of them again",
        )  # fmt: skip
    rows_before, lines_before = _sections(before)
    rows_after, lines_after = _sections(after)
    pairs, alone = matched_sections(lines_before, lines_after)
    values = [query(session.store, _VALUES).to_pandas().set_index(_KEY) for session in (before, after)]
    found: list[dict[str, object]] = []
    lines: list[Any] = []
    for pair in pairs:
        early, late = rows_before.iloc[pair.earlier], rows_after.iloc[pair.later]
        both = _values(values[0], early).merge(
            _values(values[1], late), on=["quantity", "unit"], suffixes=("", "_after")
        )
        for row in both.to_dict("records"):
            change = change_of(*(float(row[k]) for k in ("value", "value_after", "sigma", "sigma_after")))
            found.append({**{k: late[k] for k in _KEY}, **_named_before(early), "share_in_common": pair.share,
                "quantity": row["quantity"], "unit": row["unit"], "before": row["value"], "after": row["value_after"],
                "change": change.change, "sigma_change": change.sigma, "p_value": change.p_value,
                "verdict": change.verdict})  # fmt: skip
            lines.append(lines_after[pair.later])
    table = pa.table({f.name: pa.array([r[f.name] for r in found], f.type, from_pandas=True) for f in COLUMNS})
    return Changes(table, np.array([*lines, None], object)[:-1], int(alone.size), other)


def _named_before(row: pd.Series) -> dict[str, object]:
    return {
        "road_before": row["road"], "lane_before": row["lane"],
        "station_from_before_m": row["station_from_m"], "station_to_before_m": row["station_to_m"],
    }  # fmt: skip


def _values(values: pd.DataFrame, row: pd.Series) -> pd.DataFrame:
    key = tuple(row[k] for k in _KEY)
    return values.loc[[key]].reset_index(drop=True) if key in values.index else values.iloc[:0].reset_index(drop=True)


def _sections(session: Session) -> tuple[pd.DataFrame, npt.NDArray[Any]]:
    record = Manifest(session.store).of(SECTIONS).get(f"{SECTIONS}.parquet")
    if record is None:
        raise StoreError(
            f"'{session.survey.config.id}' has no sections of condition",
            expected="a run with a section [condition] in its survey file",
            change=f"run 'roadscan run' with it ({session.store.path('')})",
        )
    table, lines = read_geo_table(read_recorded(session.store, record), product_context(plan_of(session)))
    return table.to_pandas(), lines
