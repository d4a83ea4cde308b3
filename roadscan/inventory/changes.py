"""Changes on the road between two survey epochs, each with its significance, and the history of one asset.

Of two surveys of ten thousand assets some differ by 3 σ by chance alone. So moves, and changed values, count where the
expected share of false ones among them stays below 1 % (Benjamini and Hochberg 1995, J. R. Stat. Soc. B 57, 289–300).
An asset that was not seen counts as gone only where passes of the newer survey had its place in sight. The significance
of *gone* is that of as many misses in a row as there were passes, where a pass misses at most one asset in ten.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError, nearest
from roadscan.inventory.identity import outlines, points_along
from roadscan.inventory.state import live_commits
from roadscan.inventory.values import SIGMA_LEAST_M, encoded, sigma_of
from roadscan.store.asset_schema import GEOMETRY, asset_schema, asset_table
from roadscan.store.asset_truth import AssetTruth, Commit

_MISSED_BY_A_PASS: Final = 0.1  # Greatest share of the assets in sight that a pass misses.
_FALSE_SHARE: Final = 0.01  # Expected share of false changes among those reported.
_MOST_SIGMAS: Final = 38.0  # Largest significance (σ): smaller probabilities underflow.


class Change(NamedTuple):
    """One change on the road."""

    change: str
    """`appeared`, `gone`, `moved` or `changed`."""
    asset_id: str
    kind: str
    attribute: str
    before: str | None
    after: str | None
    significance: float | None
    """In σ; of `gone` the two-sided normal equivalent of its probability. Null where it has none."""
    passes_expected: int | None
    distance_m: float | None
    """Horizontal distance by which an asset moved."""
    geometry: bytes
    """Where it is; where it was if it is gone."""


@dataclass(frozen=True)
class EpochChanges:
    """Changes between two epochs."""

    before: str
    after: str
    changes: tuple[Change, ...]
    unseen: int
    """Assets of the first epoch that the second did not see and may not have had in sight: they count neither way."""

    def layer(self) -> pa.Table:
        """Returns the changes as a layer at points; geometries are left out of the values."""
        fields = [pa.field(name, _TYPES.get(name, pa.string())) for name in Change._fields]
        rows = [c._asdict() | {GEOMETRY: _point(c.geometry)} for c in self.changes]
        return pa.Table.from_pylist(rows, pa.schema(fields))


_TYPES: Final = {
    "significance": pa.float64(), "passes_expected": pa.int32(), "distance_m": pa.float64(), GEOMETRY: pa.binary(),
}  # fmt: skip


def epoch_changes(truth: AssetTruth, before: str | None, after: str | None, unit_m: float) -> EpochChanges | None:
    """Returns the changes between two epochs by name, by default the last two; None where there are fewer than two.

    Raises
    ------
    ConfigError
        where there is no such epoch.
    """
    newest: dict[str, Commit] = {}
    began: dict[str, int] = {}
    live = live_commits(truth.commits)
    for commit in live:
        if commit.kind == "found":
            newest[commit.epoch] = commit
            began.setdefault(commit.epoch, commit.epoch_gps_ns)
    names = sorted(newest, key=lambda name: (began[name], name))
    for name in (before, after):
        if name is not None and name not in newest:
            raise ConfigError(
                f"there is no epoch '{name}'{nearest(name, names)}", expected=", ".join(names) or "none yet"
            )
    if len(names) < 2:
        return None
    second = after or names[-1]
    first = before or names[max(names.index(second) - 1, 0)]
    earlier = {*names[: names.index(first) + 1]} - {second}
    came = min(c.number for c in live if c.kind == "found" and c.epoch == second)
    told = [c for c in live if (c.epoch in earlier if c.kind == "found" else c.number < came)]
    known = pa.chunked_array([_told_of(truth, c) for c in told], pa.string())
    return _between(truth, newest[first], newest[second], known, unit_m)


def _told_of(truth: AssetTruth, commit: Commit) -> pa.Array:
    """Returns ids of the assets that a commit saw, or that people drew in it."""
    name, told = ("seen", 1) if commit.kind == "found" else ("action", "create")
    rows = truth.rows(commit, ["asset_id", name])
    return rows.filter(pc.equal(rows[name], told))["asset_id"].combine_chunks()


def _between(truth: AssetTruth, before: Commit, after: Commit, known: pa.ChunkedArray, unit_m: float) -> EpochChanges:
    one, other = truth.rows(before), truth.rows(after)
    found: list[Change] = []
    moved, changed = _Compared(), _Compared()
    unseen = 0
    for kind in pc.unique(other["kind"]).to_pylist():
        pair = _pair(kind, one, other, known)
        found += [_plain("appeared", row, None, None) for row in pair.appeared.to_pylist()]
        missing = pair.unseen.filter(pc.equal(pair.unseen["status"], "missing"))
        passes = dict(zip(missing["asset_id"].to_pylist(), missing["passes_expected"].to_pylist(), strict=True))
        gone = pair.then_alone.filter(
            pc.is_in(pair.then_alone["asset_id"], value_set=missing["asset_id"].combine_chunks())
        )
        for row in gone.to_pylist():
            expected = passes[row["asset_id"]]
            found.append(_plain("gone", row, _sigmas(_MISSED_BY_A_PASS**expected), expected))
        unseen += pair.then_alone.num_rows - gone.num_rows
        _compare_places(pair, unit_m, moved)
        _compare_values(pair, changed)
    return EpochChanges(before.epoch, after.epoch, (*found, *moved.significant(), *changed.significant()), unseen)


class _Pair(NamedTuple):
    """Assets of a kind in two epochs."""

    kind: str
    then: pa.Table
    now: pa.Table
    """Rows of the assets in both epochs, in the same order as `then`."""
    then_alone: pa.Table
    appeared: pa.Table
    unseen: pa.Table
    sigma_horizontal_m: Float64
    sigma_height_m: Float64


def _pair(kind: str, one: pa.Table, other: pa.Table, known: pa.ChunkedArray) -> _Pair:
    names = ["asset_id", "seen", *asset_table(kind).names]
    names = ["kind", *dict.fromkeys(names)]
    one, other = (t.filter(pc.equal(t["kind"], kind)).select(names) for t in (one, other))
    then, now = (t.filter(pc.equal(t["seen"], 1)) for t in (one, other))
    ids = [np.asarray(t["asset_id"].to_numpy(zero_copy_only=False), dtype=str) for t in (then, now)]
    _, at_then, at_now = np.intersect1d(ids[0], ids[1], assume_unique=True, return_indices=True)
    alone = then.take(pa.array(np.setdiff1d(np.arange(ids[0].size), at_then)))
    is_known = pc.is_in(now["asset_id"], value_set=known)
    both = then.take(pa.array(at_then)), now.take(pa.array(at_now))
    horizontal, height = (
        np.maximum(np.hypot(_numbers(both[0][name], 0.0), _numbers(both[1][name], 0.0)), SIGMA_LEAST_M)
        for name in ("sigma_horizontal_m", "sigma_height_m")
    )
    unseen = other.filter(pc.equal(other["seen"], 0))
    return _Pair(kind, *both, alone, now.filter(pc.invert(is_known)), unseen, horizontal, height)


def _numbers(column: pa.ChunkedArray, missing: float = math.nan) -> Float64:
    return np.asarray(pc.fill_null(column.cast(pa.float64()), missing).to_numpy(zero_copy_only=False), dtype=float)


def _plain(change: str, row: dict[str, Any], significance: float | None, expected: int | None) -> Change:
    return Change(change, row["asset_id"], row["kind"], "", None, None, significance, expected, None, row[GEOMETRY])


def _sigmas(chance: float) -> float:
    """Returns the σ that a normal variable exceeds, to both sides, with a probability; at most 38 (underflow)."""
    from scipy.stats import norm

    return min(float(norm.isf(0.5 * max(chance, 1e-300))), _MOST_SIGMAS)


class _Compared:
    """Comparisons of one sort: the probability of each difference by chance, and a function that makes its change."""

    def __init__(self) -> None:
        self.chances: list[Float64] = []
        self.makers: list[Callable[[int], Change]] = []

    def add(self, chances: Float64, maker: Callable[[int], Change]) -> None:
        """Add comparisons; `maker` gets the position of one."""
        self.chances.append(chances)
        self.makers.append(maker)

    def significant(self) -> Iterator[Change]:
        """Yields changes up to the largest probability p(k) ≤ q k / m (Benjamini and Hochberg 1995, eq. 1)."""
        ordered = np.sort(np.concatenate([np.empty(0), *self.chances]))
        holds = np.flatnonzero(ordered <= _FALSE_SHARE * np.arange(1, ordered.size + 1) / max(ordered.size, 1))
        limit = ordered[holds[-1]] if holds.size else -1.0
        for chances, maker in zip(self.chances, self.makers, strict=True):
            for at in np.flatnonzero(chances <= limit):
                change = maker(int(at))
                yield change if chances[at] == 0.0 else change._replace(significance=_sigmas(float(chances[at])))


def _compare_places(pair: _Pair, unit_m: float, compared: _Compared) -> None:
    away_m = unit_m * _away(
        *(shapely.from_wkb(t[GEOMETRY].to_numpy(zero_copy_only=False)) for t in (pair.then, pair.now))
    )
    chance = np.exp(-0.5 * (away_m / pair.sigma_horizontal_m) ** 2)  # Rayleigh, of two coordinates

    def change(at: int) -> Change:
        row = pair.now.slice(at, 1)
        one, shape = row["asset_id"][0].as_py(), row[GEOMETRY][0].as_py()
        return Change("moved", one, pair.kind, GEOMETRY, None, None, _MOST_SIGMAS, None, float(away_m[at]), shape)

    compared.add(chance, change)


def _compare_values(pair: _Pair, compared: _Compared) -> None:
    import scipy.special

    for column in asset_schema(pair.kind).own:
        if column.is_evidence:
            continue
        was, now = pair.then[column.name], pair.now[column.name]
        sigma = sigma_of(pair.kind, column.name)
        both = np.asarray(pc.and_(pc.is_valid(was), pc.is_valid(now)))
        if sigma is None:
            differs = both & np.asarray(pc.fill_null(pc.not_equal(was, now), False))
            chance = np.where(differs, 0.0, 1.0)[both]
        else:
            a, b = _numbers(was)[both], _numbers(now)[both]
            width = sigma(pair.sigma_horizontal_m[both], pair.sigma_height_m[both], np.maximum(np.abs(a), np.abs(b)))
            chance = scipy.special.erfc(np.abs(a - b) / (math.sqrt(2.0) * width))
        compared.add(chance, _value_changes(pair, column.name, np.flatnonzero(both), is_text=sigma is None))


def _value_changes(pair: _Pair, name: str, places: Int64, *, is_text: bool) -> Callable[[int], Change]:
    def change(at: int) -> Change:
        row = int(places[at])
        one, shape = pair.now["asset_id"][row].as_py(), pair.now[GEOMETRY][row].as_py()
        was, now = encoded(pair.then[name][row].as_py()), encoded(pair.now[name][row].as_py())
        return Change("changed", one, pair.kind, name, was, now, None if is_text else _MOST_SIGMAS, None, None, shape)

    return change


def _away(old: npt.NDArray[Any], new: npt.NDArray[Any]) -> Float64:
    """Returns horizontal distances in the map's unit; for lines and areas the median along them."""
    if not len(old) or shapely.get_type_id(old[0]) == 0:
        return np.asarray(shapely.distance(old, new), dtype=float)
    lines = outlines(old), outlines(new)
    away = shapely.distance(points_along(lines[1]), lines[0][:, np.newaxis])
    return np.asarray(np.median(away, axis=1), dtype=float)


def _point(geometry: bytes) -> bytes:
    shape = shapely.from_wkb(geometry)
    if shape.geom_type == "Point":
        return geometry
    first = shapely.get_coordinates(shape, include_z=True)[0]
    return bytes(shapely.to_wkb(shapely.Point(first), flavor="iso"))


class Event(NamedTuple):
    """One event in an asset's history."""

    commit: int
    at: str
    who: str
    what: str
    """`found`, `not seen`, `edited`, `drawn`, `withdrawn` or `undone`."""
    attribute: str
    old: str | None
    """As JSON; so is `new`."""
    new: str | None
    why: str


def history_of(truth: AssetTruth, asset_id: str) -> list[Event]:
    """Returns the events of an asset, in the order of the commits."""
    counted = {c.number for c in live_commits(truth.commits)}
    touched: set[int] = set()
    events: list[Event] = []
    for commit in truth.commits:
        if commit.kind == "undo":
            if commit.undoes in touched:
                touched.add(commit.number)
                events.append(
                    Event(commit.number, commit.at, commit.who, "undone", "", str(commit.undoes), None, commit.why)
                )
            continue
        own = list(_events(truth, commit, asset_id))
        if own:
            touched.add(commit.number)
        events += [e if commit.number in counted else e._replace(why=f"{e.why} (undone)".strip()) for e in own]
    return events


def _events(truth: AssetTruth, commit: Commit, asset_id: str) -> Iterator[Event]:
    rows = truth.rows(commit)
    for row in rows.filter(pc.equal(rows["asset_id"], asset_id)).to_pylist():
        if commit.kind == "found" and row["seen"]:
            where = f"{row['easting_m']:.3f} {row['northing_m']:.3f} {row['height_m']:.3f}"
            yield Event(commit.number, commit.at, commit.who, "found", "", None, where, f"epoch {commit.epoch}")
        elif commit.kind == "found":
            expected = row["passes_expected"]
            told = "not known how many passes should have" if expected is None else f"{expected} passes should have"
            yield Event(
                commit.number, commit.at, commit.who, "not seen", "", None, None, f"epoch {commit.epoch}; {told}"
            )
        else:
            what = {"create": "drawn", "set": "edited", "withdraw": "withdrawn"}[row["action"]]
            values = (row["attribute"], row["old"], row["new"], row["why"])
            yield Event(commit.number, row["made_at"], row["who"], what, *values)
