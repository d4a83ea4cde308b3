"""What changed on the road between two survey epochs: appeared, gone, moved, changed, each with its significance.

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

from roadscan.inventory.conflicts import SIGNIFICANT
from roadscan.inventory.state import live_commits
from roadscan.inventory.values import encoded, sigmas_apart
from roadscan.model.errors import ConfigError, nearest
from roadscan.tables.asset_schema import asset_schema
from roadscan.tables.asset_truth import AssetTruth, Commit
from roadscan.tables.inventory_schema import GEOMETRY

_MISSED_BY_A_PASS: Final = 0.1
_SAMPLES: Final = 16


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
            raise ConfigError(f"there is no epoch '{name}'{nearest(name, names)}", expected=", ".join(names) or "none yet")
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
    unseen = 0
    for row in other.to_pylist():
        old = then.get(row["asset_id"])
        if row["seen"] and old is not None:
            found += _changed(old, row, unit_m)
        elif row["seen"] and row["asset_id"] not in known:
            found.append(_plain("appeared", row, None, None))
        elif old is not None and row["status"] == "missing":
            found.append(_plain("gone", old, _of_misses(row["passes_expected"]), row["passes_expected"]))
        elif old is not None:
            unseen += 1
    return EpochChanges(before.epoch, after.epoch, tuple(found), unseen)


def _plain(change: str, row: dict[str, Any], significance: float | None, expected: int | None) -> Change:
    return Change(change, row["asset_id"], row["kind"], "", None, None, significance, expected, None, row[GEOMETRY])


def _of_misses(passes: int) -> float:
    from scipy.stats import norm

    return float(norm.isf(0.5 * _MISSED_BY_A_PASS**passes))


def _changed(old: dict[str, Any], new: dict[str, Any], unit_m: float) -> Iterator[Change]:
    kind = new["kind"]
    sigma = {
        name: math.hypot(old[name] or 0.0, new[name] or 0.0) for name in ("sigma_horizontal_m", "sigma_height_m")
    }
    away_m, significance = _moved(old[GEOMETRY], new[GEOMETRY], sigma, unit_m)
    if significance > SIGNIFICANT:
        yield Change("moved", new["asset_id"], kind, GEOMETRY, None, None, significance, None, away_m, new[GEOMETRY])
    for column in asset_schema(kind).own:
        was, now = old[column.name], new[column.name]
        if was is None or now is None or was == now:
            continue
        by = sigmas_apart(kind, column.name, was, now, sigma)
        if by > SIGNIFICANT:
            values = (encoded(was), encoded(now), by if math.isfinite(by) else None)
            yield Change("changed", new["asset_id"], kind, column.name, *values, None, None, new[GEOMETRY])


def _moved(old: bytes, new: bytes, sigma: dict[str, float], unit_m: float) -> tuple[float, float]:
    """Horizontal distance (m) of two places and its significance; of lines and areas the median along them."""
    a, b = shapely.from_wkb(old), shapely.from_wkb(new)
    if a.geom_type != "Point":
        a, b = (shapely.get_exterior_ring(s) if s.geom_type == "Polygon" else s for s in (a, b))
        along = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        away = float(np.median(shapely.distance(shapely.line_interpolate_point(b, along, normalized=True), a)))
    else:
        away = float(shapely.distance(a, b))
    return away * unit_m, away * unit_m / max(sigma["sigma_horizontal_m"], 0.005)


def _point(geometry: bytes) -> bytes:
    shape = shapely.from_wkb(geometry)
    if shape.geom_type == "Point":
        return geometry
    first = shapely.get_coordinates(shape, include_z=True)[0]
    return bytes(shapely.to_wkb(shapely.Point(first), flavor="iso"))
