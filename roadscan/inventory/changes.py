"""What changed on the road between two survey epochs: appeared, gone, moved, changed, each with its significance.

Of two surveys of ten thousand assets some differ by 3 σ by chance alone. So moves, and changed values, count where the
expected share of false ones among them stays below 1 % (Benjamini and Hochberg 1995, J. R. Stat. Soc. B 57, 289–300).
An asset that was not seen counts as gone only where passes of the newer survey had its place in sight. The significance
of *gone* is that of as many misses in a row as there were passes, where a pass misses at most one asset in ten.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from roadscan.inventory.state import live_commits
from roadscan.inventory.values import encoded, sigmas_apart
from roadscan.model.errors import ConfigError, nearest
from roadscan.tables.asset_schema import asset_schema
from roadscan.tables.asset_truth import AssetTruth, Commit
from roadscan.tables.inventory_schema import GEOMETRY

_MISSED_BY_A_PASS: Final = 0.1
_FALSE_SHARE: Final = 0.01
_SAMPLES: Final = 16
_LEAST_M: Final = 0.005


class Change(NamedTuple):
    """One change of the road."""

    change: str
    """`appeared`, `gone`, `moved` or `changed`."""
    asset_id: str
    kind: str
    attribute: str
    before: str | None
    after: str | None
    significance: float | None
    """σ; of gone the two-sided normal equivalent of its probability. Null where it has none."""
    passes_expected: int | None
    distance_m: float | None
    """How far a moved asset went, horizontally."""
    geometry: bytes
    """Where it is; of what is gone where it was."""


@dataclass(frozen=True)
class EpochChanges:
    """Changes between two epochs."""

    before: str
    after: str
    changes: tuple[Change, ...]
    unseen: int
    """Assets of the first epoch that the second did not see and may not have had in sight: they say nothing."""

    def layer(self) -> pa.Table:
        """The changes at points, as a layer; geometries are left out of the values."""
        fields = [pa.field(name, _TYPES.get(name, pa.string())) for name in Change._fields]
        rows = [c._asdict() | {GEOMETRY: _point(c.geometry)} for c in self.changes]
        return pa.Table.from_pylist(rows, pa.schema(fields))


_TYPES: Final = {
    "significance": pa.float64(), "passes_expected": pa.int32(), "distance_m": pa.float64(), GEOMETRY: pa.binary(),
}  # fmt: skip


def epoch_changes(truth: AssetTruth, before: str | None, after: str | None, unit_m: float) -> EpochChanges | None:
    """Changes between two epochs by name, the last two where they are left out; None where there are less than two.

    Raises
    ------
    ConfigError
        where there is no such epoch.
    """
    newest: dict[str, Commit] = {}
    began: dict[str, int] = {}
    for commit in live_commits(truth.commits):
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
    return _between(truth, newest[first], newest[second], unit_m)


def _between(truth: AssetTruth, before: Commit, after: Commit, unit_m: float) -> EpochChanges:
    one, other = truth.rows(before), truth.rows(after)
    known = set(one["asset_id"].to_pylist())
    then = {row["asset_id"]: row for row in one.filter(pc.equal(one["seen"], 1)).to_pylist()}
    found: list[Change] = []
    compared: dict[str, list[tuple[float, Change]]] = {"moved": [], "changed": []}
    unseen = 0
    for row in other.to_pylist():
        old = then.get(row["asset_id"])
        if row["seen"] and old is not None:
            for chance, change in _compared(old, row, unit_m):
                compared[change.change].append((chance, change))
        elif row["seen"] and row["asset_id"] not in known:
            found.append(_plain("appeared", row, None, None))
        elif old is not None and row["status"] == "missing":
            chance = _MISSED_BY_A_PASS ** row["passes_expected"]
            found.append(_plain("gone", old, _sigmas(chance), row["passes_expected"]))
        elif old is not None:
            unseen += 1
    found += [change for own in compared.values() for change in _significant(own)]
    return EpochChanges(before.epoch, after.epoch, tuple(found), unseen)


def _plain(change: str, row: dict[str, Any], significance: float | None, expected: int | None) -> Change:
    return Change(change, row["asset_id"], row["kind"], "", None, None, significance, expected, None, row[GEOMETRY])


def _sigmas(chance: float) -> float:
    """σ of a normal variable that is exceeded to both sides with a probability; at most 38, where numbers end."""
    from scipy.stats import norm

    return min(float(norm.isf(0.5 * max(chance, 1e-300))), 38.0)


def _significant(compared: list[tuple[float, Change]]) -> Iterator[Change]:
    """Changes up to the largest probability p(k) ≤ q k / m (Benjamini and Hochberg 1995, eq. 1), in their order."""
    chances = np.sort([chance for chance, _ in compared])
    holds = np.flatnonzero(chances <= _FALSE_SHARE * np.arange(1, chances.size + 1) / max(chances.size, 1))
    if not holds.size:
        return
    limit = chances[holds[-1]]
    for chance, change in compared:
        if chance <= limit:
            yield change._replace(significance=_sigmas(chance) if change.significance is None else None)


def _compared(old: dict[str, Any], new: dict[str, Any], unit_m: float) -> Iterator[tuple[float, Change]]:
    """Each comparison of an asset that both saw: the probability of so great a difference by chance, and the change."""
    kind, one = new["kind"], new["asset_id"]
    sigma = {name: math.hypot(old[name] or 0.0, new[name] or 0.0) for name in ("sigma_horizontal_m", "sigma_height_m")}
    away_m = _away(old[GEOMETRY], new[GEOMETRY]) * unit_m
    chance = math.exp(-0.5 * (away_m / max(sigma["sigma_horizontal_m"], _LEAST_M)) ** 2)  # Rayleigh, of two coordinates
    yield chance, Change("moved", one, kind, GEOMETRY, None, None, None, None, away_m, new[GEOMETRY])
    for column in asset_schema(kind).own:
        was, now = old[column.name], new[column.name]
        if was is None or now is None:
            continue
        by = sigmas_apart(kind, column.name, was, now, sigma)
        change = Change("changed", one, kind, column.name, encoded(was), encoded(now), None, None, None, new[GEOMETRY])
        if math.isfinite(by):
            yield math.erfc(by / math.sqrt(2.0)), change
        else:
            yield 0.0, change._replace(significance=math.inf)  # a text: it has no σ


def _away(old: bytes, new: bytes) -> float:
    """Horizontal distance of two places, of lines and areas the median along them, in the map's own unit."""
    a, b = shapely.from_wkb(old), shapely.from_wkb(new)
    if a.geom_type == "Point":
        return float(shapely.distance(a, b))
    a, b = (shapely.get_exterior_ring(s) if s.geom_type == "Polygon" else s for s in (a, b))
    along = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return float(np.median(shapely.distance(shapely.line_interpolate_point(b, along, normalized=True), a)))


def _point(geometry: bytes) -> bytes:
    shape = shapely.from_wkb(geometry)
    if shape.geom_type == "Point":
        return geometry
    first = shapely.get_coordinates(shape, include_z=True)[0]
    return bytes(shapely.to_wkb(shapely.Point(first), flavor="iso"))
