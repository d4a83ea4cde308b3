"""The sort of each stretch of an upright surface: judges tell fences, guard rails, solid surfaces and what is none."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.judgement.judge import Judge
from roadscan.assets.upright.lines import Chain
from roadscan.assets.upright.panels import COLUMNS, LEAST_LINES
from roadscan.compute.array_types import Bool, Float64

JUDGES: Final = {
    "no_surface": Judge("no_surface", "2011af556f642048"),
    "fence": Judge("fence", "55b5a11d4e61b1b7"),
    "guardrail": Judge("guardrail", "2205de709afa5a89"),
    "solid": Judge("solid", "4b8820769524e1ad"),
}
"""What a stretch is: a hedge, a vehicle, a trunk or anything else that is no surface; what lets sight lines through all
along; a rail on posts; a wall, a barrier, a front or a fence of panels."""
_WINDOWS_M: Final = (2.6, 8.1)
"""A stretch is told by those around it too, so far along the surface (m): by two on each side, and by those of two
posts of a guard rail."""
_ALIKE_M: Final = 0.4
"""Stretches around it whose tops lie higher or lower by more (m) are of something else."""
_MOST_AROUND: Final = 24
"""Stretches before and behind that are looked at; pieces of stretches at the borders of squares are short."""
_LONGEST_M: Final = 40.0
"""Longer surfaces count as so long (m)."""
_LEAST_LINES: Final = 15.0  # Fewer sight lines at a stretch do not tell whether it is porous.
_MANY_PASSING: Final = 4.0  # So many lines that pass tell it, however few there are.
_LEAST_PASSING: Final = 0.02  # Share of the sight lines that a porous stretch lets through.
_LEAST_LINES_AROUND, _LEAST_BELOW = 15.0, 5.0
"""Fewer sight lines at the stretches around one, and below their lower edges, tell nothing."""


def probabilities_of(chain: Chain) -> Float64:
    """Returns the probability (k, 4) that each stretch of a surface is of each sort, in the order of `JUDGES`.

    A stretch without returns is of any of them.
    """
    features = features_of(chain)
    odds = np.column_stack([judge.probability(features) for judge in JUDGES.values()])
    told: Float64 = odds / odds.sum(axis=1, keepdims=True)
    told[~np.isfinite(features["top_m"])] = 1.0 / len(JUDGES)
    return told


def features_of(chain: Chain) -> dict[str, Float64]:
    """Returns what tells the sort of each stretch (k,) of a surface, by name; NaN where it is not known."""
    v = chain.values
    length = v["length_m"]
    top, low, bulk, full = (v[name] - v["ground_m"] for name in ("high_m", "low_m", "bulk_m", "top_m"))
    lines = v["passed"] + v["stopped"]
    out = {
        "top_m": top, "low_m": low, "bulk_m": bulk, "rise_m": full - top, "lines": np.log1p(lines),
        "leaves": v["leaves"] / np.maximum(v["returns"], 1.0), "open_top": v["open_top"],
        "passing": _share(v["passed"], lines, LEAST_LINES),
        "across_m": np.full(length.size, chain.across_m),
        "length_m": np.full(length.size, min(chain.length_m, _LONGEST_M)),
    }  # fmt: skip
    around = _Around(np.cumsum(length) - length / 2, top)
    for window_m in _WINDOWS_M:
        own = _of_window(chain, around.within(window_m, alike=True), {"top_m": top, "low_m": low, "bulk_m": bulk})
        out |= {f"{name}_{window_m:.0f}": value for name, value in own.items()}
    out["highest_m"] = around.within(_WINDOWS_M[-1], alike=False).highest(np.nan_to_num(top))
    return out


def _of_window(chain: Chain, near: _Near, heights: dict[str, Float64]) -> dict[str, Float64]:
    """Returns what the alike stretches around each one tell (k,), by name."""
    v = chain.values
    passed, stopped, under, foot = (near.sum(v[name]) for name in ("passed", "stopped", "under", "foot"))
    columns, opened = near.sum(v["columns"]), near.sum(v["open_columns"])
    lines = passed + stopped
    at_each = v["passed"] + v["stopped"]
    told = (at_each >= _LEAST_LINES) | (v["passed"] >= _MANY_PASSING)
    through = v["passed"] - 1.0 >= _LEAST_PASSING * at_each  # one line may be a false return
    told_m = near.sum(told * v["length_m"])
    # what lets a share of the lines through everywhere opens so many columns; openings in what is solid open fewer
    share = passed / np.maximum(lines, 1.0)
    in_column = np.maximum(lines / np.maximum(near.sum(np.full(told.size, float(COLUMNS))), 1.0), LEAST_LINES)
    expected = columns * (1.0 - (1.0 - share) ** in_column)
    out = {
        "passing": _share(passed, lines, _LEAST_LINES_AROUND),
        "through": _share(near.sum(told * through * v["length_m"]), told_m, 0.0),
        "open": _share(opened, columns, 0.0),
        "evenly": np.where(expected > 0.5, opened / np.maximum(expected, 0.5), np.nan),
        "leaves": near.sum(v["leaves"]) / np.maximum(near.sum(v["returns"]), 1.0),
        "hovers": under / np.maximum(under + stopped, 1.0),
        "foot": _share(foot, foot + under, _LEAST_BELOW),
        "long_m": near.sum(v["length_m"]),
    }
    for name, value in heights.items():
        lower, out[name], upper = near.quartiles(value)
        if name != "bulk_m":
            out[f"rough_{name}"] = upper - lower
    return out


def _share(part: Float64, of: Float64, least: float) -> Float64:
    out: Float64 = np.where((of >= least) & (of > 0.0), part / np.maximum(of, 1e-9), np.nan)
    return out


class _Near:
    """Some stretches around each one: their numbers (k, w) and which of them count."""

    def __init__(self, number: npt.NDArray[np.int64], counts: Bool) -> None:
        self._number, self._counts = number, counts

    def sum(self, values: Float64) -> Float64:
        """Returns the sum (k,) of the values (k,) of those around each."""
        out: Float64 = (values[self._number] * self._counts).sum(axis=1)
        return out

    def highest(self, values: Float64) -> Float64:
        """Returns the greatest of the values (k,) of those around each."""
        out: Float64 = np.where(self._counts, values[self._number], -np.inf).max(axis=1)
        return out

    def quartiles(self, values: Float64) -> Float64:
        """Returns the quartiles (3, k) of the values that are known around each; NaN of none."""
        known = np.sort(np.where(self._counts, values[self._number], np.nan), axis=1)  # NaN comes last
        many = np.isfinite(known).sum(axis=1)
        at = np.array([[0.25], [0.5], [0.75]]) * np.maximum(many - 1, 0)
        first = np.floor(at).astype(np.int64)
        row = np.arange(many.size)
        lower, upper = known[row, first], known[row, np.minimum(first + 1, np.maximum(many - 1, 0))]
        out: Float64 = lower + (at - first) * (upper - lower)
        return out


class _Around:
    """The stretches of a surface by their places along it."""

    def __init__(self, at_m: Float64, top_m: Float64) -> None:
        step = np.arange(-_MOST_AROUND, _MOST_AROUND + 1)
        number = np.arange(at_m.size)[:, None] + step
        self._number = number.clip(0, at_m.size - 1)
        self._inside = self._number == number
        self._away_m = np.abs(at_m[self._number] - at_m[:, None])
        self._apart_m = np.where(step == 0, 0.0, np.abs(top_m[self._number] - top_m[:, None]))

    def within(self, reach_m: float, *, alike: bool) -> _Near:
        """Returns those so near to each along the surface (m), all or those whose tops are alike."""
        counts = self._inside & (self._away_m <= reach_m)
        return _Near(self._number, counts & (self._apart_m <= _ALIKE_M) if alike else counts)
