"""Which stretches of an upright surface are a boundary that people made, and which let beams through.

Walls, fences and rails are thin, even and stand by themselves; hedges have leaves before and behind their face, houses
a storey above it. Both questions are answered by judges (:mod:`roadscan.assets.judgement`), stretch by stretch, so a
line may be a wall for a part of its way, a gate for the next, and the front of a house for the last.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.judgement.judge import Judge
from roadscan.assets.upright.lines import Chain

Float64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

BOUNDARY: Final = Judge("boundary", "6c1951afed3953c4")
"""Whether a stretch belongs to a wall, a fence, a rail or a barrier, and not to a hedge, a house or a vehicle."""
FENCE: Final = Judge("fence", "0b8209e8146e815f")
"""Whether one that does lets beams through."""
_NEAR_M, _FAR_M = 1.6, 4.1
"""A stretch is judged with those of its chain whose middles lie so near along it (m): itself with one to each side, and
what tells a gap from a fence that lets beams through all along."""
_ALIKE_M: Final = 0.35
"""… and whose upper edges are as high within this (m): a gate beside a house is judged by itself."""
_LEAST_LINES: Final = 4.0
"""Fewer sight lines at a stretch and those near do not tell how many pass."""


def judged(chain: Chain) -> tuple[Float64, Float64]:
    """Returns the probabilities (k,) of the stretches of a chain to be a boundary, and to let beams through if so.

    The first are means over the stretches near that are as high: what something hides is what lies beside it.
    """
    features, (_, far, _), length = features_of(chain), _near(chain), chain.values["length_m"]
    of_boundary = _sums(far, length * BOUNDARY.probability(features)) / _sums(far, length)
    return of_boundary, FENCE.probability(features)


def features_of(chain: Chain) -> dict[str, Float64]:
    """Returns features (k,) of the stretches of a chain; NaN where one is not known."""
    v, (near, far, run) = chain.values, _near(chain)
    top, around = v["high_m"] - v["ground_m"], _apart_m(v["length_m"]) <= _FAR_M
    length, within, returns = (_sums(near, v[name]) for name in ("length_m", "within", "returns"))
    lines, under = _sums(near, v["stopped"] + v["passed"]), _sums(near, v["under"])
    out = {name: _mean(near, v[f"{name}_m"] - v["ground_m"]) for name in ("low", "bulk", "high")}
    for name, mask in (("", near), ("_far", far), ("_run", run)):
        out[f"passing{name}"] = _share(_sums(mask, v["passed"]), _sums(mask, v["stopped"] + v["passed"]))
        out[f"missing{name}"] = _share(_sums(mask, v["missed"]), _sums(mask, v["beams"]))
    return out | {
        "uneven": np.sqrt(np.maximum(_mean(far, top**2) - _mean(far, top) ** 2, 0.0)),
        "lines": lines,
        "under": under / np.maximum(lines + under, 1.0),
        "leafy": _sums(near, v["leafy"]) / np.maximum(returns, 1.0),
        "leafy_far": _sums(far, v["leafy"]) / np.maximum(_sums(far, v["returns"]), 1.0),
        "dense": returns / np.maximum(length, 0.1),
        "thick_m": _sums(near, v["off_m"]) / np.maximum(within, 1.0),
        **{name: (1.0 + _sums(near, v[name])) / (1.0 + within) for name in ("before", "behind", "over")},
        "open_top": _sums(near, v["open_top"] * v["length_m"]) / np.maximum(length, 0.1),
        "covered": _sums(around, v["length_m"] * np.isfinite(top)) / np.maximum(_sums(around, v["length_m"]), 0.1),
        "across_m": np.full(top.size, chain.across_m),
        "run": _sums(run, v["length_m"]),
        "chain": np.full(top.size, chain.length_m),
    }


def _near(chain: Chain) -> tuple[Bools, Bools, Bools]:
    """Returns masks (k, k) of stretches that are near, less near, or of one chain, and as high."""
    top, apart = chain.values["high_m"] - chain.values["ground_m"], _apart_m(chain.values["length_m"])
    alike = (np.abs(top[:, None] - top[None]) <= _ALIKE_M) | np.eye(top.size, dtype=bool)
    return alike & (apart <= _NEAR_M), alike & (apart <= _FAR_M), alike


def _apart_m(length_m: Float64) -> Float64:
    """Returns distances (k, k) between the middles of stretches, along them (m)."""
    middle = np.cumsum(length_m) - length_m / 2
    return np.asarray(np.abs(middle[:, None] - middle[None]))


def _sums(mask: Bools, values: Float64) -> Float64:
    """Returns sums (k,) of values over each row of a mask; a product of matrices has other bits on other processors."""
    return np.asarray(np.where(mask, values, 0.0).sum(axis=1))


def _share(part: Float64, whole: Float64) -> Float64:
    """Returns shares (k,); NaN of too few."""
    return np.where(whole >= _LEAST_LINES, part / np.maximum(whole, 1.0), np.nan)


def _mean(mask: Bools, values: Float64) -> Float64:
    """Returns means (k,) of known values over each row of a mask; NaN where none is."""
    known = mask & np.isfinite(values)
    number = known.sum(axis=1)
    return np.where(number > 0, _sums(known, values) / np.maximum(number, 1), np.nan)
