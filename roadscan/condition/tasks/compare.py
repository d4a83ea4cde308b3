"""Compares two surveys of a road: matches their sections, and computes the change of every quantity."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pa_csv
import shapely

from roadscan.compute.array_types import Float64
from roadscan.condition.index import Value, condition_indices
from roadscan.condition.lane_data import LaneData, Profile
from roadscan.condition.settings import ConditionConfig
from roadscan.condition.tasks.sections import SECTIONS
from roadscan.condition.tasks.values import Group, GroupTask, load_lane
from roadscan.condition.tasks.work import plan_condition
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


BESIDE_M: Final = 1.5
"""Largest distance between the middles of sections of one lane (m): half a narrow lane."""
LEAST_SHARE: Final = 0.9
"""Least common share of the lengths of sections that are compared."""
MOST_TURN_DEG: Final = 45.0
"""Largest angle between sections of one direction."""

Verdict: TypeAlias = Literal["larger", "smaller", "no change shown", "not judged"]
VERDICTS: Final[tuple[Verdict, ...]] = get_args(Verdict)


class Pair(NamedTuple):
    """A section of the later survey, and the matching one of the earlier survey."""

    later: int
    earlier: int
    share: float
    """Length in common, divided by that of the longer section."""


@dataclass(frozen=True)
class Change:
    """The change of a quantity."""

    change: float
    """Later minus earlier, in the quantity's unit."""
    sigma: float
    """1 σ of it, from both surveys taken as independent; NaN where one states none."""
    p_value: float
    """Probability of so large a change, or a larger one, if nothing changed; NaN without σ."""
    verdict: Verdict


def matched_sections(earlier: npt.NDArray[Any], later: npt.NDArray[Any]) -> tuple[list[Pair], npt.NDArray[np.int64]]:
    """Return sections on the same piece of the same lane, and the rows of the later survey without a match.

    Parameters
    ----------
    earlier, later : (n,), (m,) shapely lines along the middle of each section's lane, in one map (m), in the direction
        of travel.
    """
    pairs: list[Pair] = []
    alone: list[int] = []
    tree = shapely.STRtree(earlier)
    for row, line in enumerate(later):
        near = tree.query(line, predicate="dwithin", distance=BESIDE_M) if len(earlier) else np.empty(0, np.int64)
        shares = [_share(earlier[k], line) for k in near.tolist()]
        best = int(np.argmax(shares)) if shares else -1
        if best >= 0 and shares[best] >= LEAST_SHARE:
            pairs.append(Pair(row, int(near[best]), shares[best]))
        else:
            alone.append(row)
    return pairs, np.array(alone, np.int64)


def change_of(earlier: float, later: float, sigma_earlier: float, sigma_later: float, level: float = 0.05) -> Change:
    """Return the change of a quantity, and whether it exceeds the errors of both surveys, two-sided.

    `level` : a change whose probability without any change is below this is significant.
    """
    change, sigma = later - earlier, math.hypot(sigma_earlier, sigma_later)
    if not (math.isfinite(change) and sigma > 0.0):  # also for NaN
        return Change(change, math.nan, math.nan, "not judged")
    p_value = math.erfc(abs(change) / sigma / math.sqrt(2.0))
    if p_value >= level:
        return Change(change, sigma, p_value, "no change shown")
    return Change(change, sigma, p_value, "larger" if change > 0.0 else "smaller")


def _share(one: shapely.LineString, other: shapely.LineString) -> float:
    """Return the common length of two lines, divided by that of the longer; 0 for different directions."""
    if _turn_deg(one, other) > MOST_TURN_DEG:
        return 0.0
    beside = shapely.buffer(one, BESIDE_M, cap_style="flat")
    return float(shapely.length(shapely.intersection(other, beside)) / max(one.length, other.length))


def _turn_deg(one: shapely.LineString, other: shapely.LineString) -> float:
    chords = [np.subtract(line.coords[-1][:2], line.coords[0][:2]) for line in (one, other)]
    turn = math.atan2(*reversed(chords[0])) - math.atan2(*reversed(chords[1]))
    return abs(math.degrees(math.remainder(turn, 2.0 * math.pi)))


HeightAt: TypeAlias = Callable[[Float64, Float64], Float64]
"""Function that gives true heights (n,) at eastings and northings (n,)."""


@dataclass(frozen=True)
class Compared:
    """A value, and that of the true surface."""

    road: str
    lane: str
    found: Value
    true: Value


def compared_values(session: Session, height_at: HeightAt) -> Iterator[Compared]:
    """Return all values of the store beside those of the truth; profiles and cross-sections have to be computed."""
    config = ConditionConfig.stated(session.survey)
    if config is None:
        return
    context = product_context(plan_of(session))
    for group in plan_condition(session).groups:
        task = GroupTask(session.store, config.sections(), plan_of(session).ground.grid.cell_m, context, group)
        lane = load_lane(task)
        true = true_lane(group, lane, height_at)
        for index in condition_indices().values():
            if index.needs_cracks:
                continue
            beside = {(v.quantity, v.extent, v.from_m, v.to_m): v for v in index.values(true)}
            for value in index.values(lane):
                known = beside.get((value.quantity, value.extent, value.from_m, value.to_m))
                if known is not None:
                    yield Compared(group.lane.road, group.lane.name, value, known)


def true_lane(group: Group, lane: LaneData, height_at: HeightAt) -> LaneData:
    """Return the lane with the true heights at its places."""
    profiles = {side: _true_profile(profile, height_at) for side, profile in lane.profiles.items()}
    cross = lane.cross_sections
    n, m = cross.height_m.shape
    station = np.repeat(cross.station_m, m)
    places = group.line.places(station, group.lane.offsets(station, np.tile(cross.offset_m, n)))
    height = height_at(places[:, 0], places[:, 1]).reshape(n, m) - cross.base_m[:, None]
    return replace(
        lane, profiles=profiles, cross_sections=replace(cross, height_m=height, sigma_m=np.zeros((n, m))), window_m2=0.0
    )


def _true_profile(profile: Profile, height_at: HeightAt) -> Profile:
    height = height_at(profile.place_m[:, 0], profile.place_m[:, 1])
    return replace(profile, height_m=height, sigma_m=np.zeros(height.size))
