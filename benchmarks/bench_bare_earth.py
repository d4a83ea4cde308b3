"""Filters of bare earth side by side on ten samples of the ISPRS filter test, and our setting chosen from them.

Each method has a few settings. "Given" is the setting with the least mean total error of the ten samples. "Left out"
scores each sample with the setting that is best on the other nine. A harder copy of each sample, whose returns were
moved onto drawn terraces, is scored alone: it chooses nothing. Ours keeps slope and window of Pingel, Clarke, McBride
(2013); its :class:`~roadscan.assets.ground.sparse.SparseRules` are
what the ten choose. "All chosen" chooses slope and window too.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from benchmarks import ground_filters
from benchmarks.ground_filters import Sample
from benchmarks.timing import Figure
from roadscan.assets.ground.sparse import SparseRules, sparse_ground
from roadscan.assets.ground.surface import Place
from roadscan.assets.scene import Box
from roadscan.assets.settings import GroundSettings
from tests.assets.airborne import airborne
from tests.assets.isprs import SAMPLES, isprs_sample

Float64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


class Method(NamedTuple):
    """A filter and the settings that are tried: all combinations of these values."""

    mask: Callable[..., Bools]
    values: dict[str, tuple[Any, ...]]

    def settings(self) -> list[dict[str, Any]]:
        """Returns all combinations."""
        return [dict(zip(self.values, one, strict=True)) for one in itertools.product(*self.values.values())]


def ours(sample: Sample, *, steepest: float, largest_object_m: float, **rules: float) -> Bools:
    """Returns what `roadscan` takes for ground."""
    points = sample.points
    window = Box(0.0, 0.0, *(np.floor(points[:, :2].max(axis=0)) + 1.0).tolist())
    settings = GroundSettings(steepest=steepest, largest_object_m=largest_object_m)
    return sparse_ground(Place(airborne(points), window, settings), SparseRules(**rules)).on_ground


METHODS = {
    "SMRF": Method(
        ground_filters.smrf,
        {"slope": (0.1, 0.15, 0.2, 0.3), "window_m": (18.0, 24.0), "threshold_m": (0.5,), "scaling": (1.0, 1.25, 1.5)},
    ),
    "PMF": Method(ground_filters.pmf, {"slope": (0.1, 0.2, 0.4), "window_m": (16.0, 32.0), "most_m": (1.0, 2.5, 5.0)}),
    "progressive TIN": Method(
        ground_filters.progressive_tin,
        {"building_m": (40.0,), "angle_deg": (6.0, 12.0, 24.0), "distance_m": (1.4,)},
    ),
    "cloth": Method(ground_filters.cloth, {"cell_m": (1.0, 2.0), "rigidness": (1, 2, 3), "threshold_m": (0.5,)}),
    "ours": Method(
        ours,
        {
            "steepest": (0.15,),
            "largest_object_m": (18.0,),
            "tolerance_slope_m": (1.25, 1.5),
            "drop_m": (0.8, 1.5),
        },
    ),
    "ours, all chosen": Method(
        ours,
        {
            "steepest": (0.12, 0.15, 0.2),
            "largest_object_m": (18.0, 24.0),
            "tolerance_slope_m": (1.25, 1.5),
            "drop_m": (0.8, 1.5),
        },
    ),
}


def terraced(points: Float64, seed: int) -> Float64:
    """Returns points (n, 3) moved onto terraces of 2–7 m, whose faces take 3–15 % of their width."""
    draw = np.random.default_rng(seed)
    length, turn, phase = draw.uniform(80.0, 200.0, 5), draw.uniform(0.0, 2.0 * np.pi, 5), draw.uniform(0.0, 6.3, 5)
    waves = 2.0 * np.pi / length * np.array([np.cos(turn), np.sin(turn)])
    step = np.cos(points[:, :2] @ waves + phase).sum(axis=1) * draw.uniform(0.6, 1.2)
    whole = np.floor(step)
    face = np.clip((step - whole) / draw.uniform(0.03, 0.15), 0.0, 1.0)
    return points + np.outer(draw.uniform(2.0, 7.0) * (whole + face), [0.0, 0.0, 1.0])


def errors(method: Method, samples: list[tuple[Sample, Bools]]) -> Float64:
    """Returns the total error of each setting on each sample (%)."""
    return np.array([[100.0 * np.mean(method.mask(p, **one) != g) for p, g in samples] for one in method.settings()])


def left_out(wrong: Float64) -> Float64:
    """Returns the error of each sample under the setting that is best on all others (%)."""
    total = wrong.sum(axis=1)
    return np.array([wrong[np.argmin(total - wrong[:, k]), k] for k in range(wrong.shape[1])])


def figures(folder: Path) -> Iterator[Figure]:
    """Mean total error of each method, left out and given, the errors of the samples left out, and what is chosen."""
    recordings = Path(os.environ.get("ROADSCAN_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    read = [isprs_sample(recordings, sample) for sample in SAMPLES]
    samples = [(Sample(points), on_ground) for points, on_ground in read]
    copies = [(Sample(terraced(points, k)), on_ground) for k, (points, on_ground) in enumerate(read)]
    for name, method in METHODS.items():
        wrong = errors(method, samples)
        best = int(np.argmin(wrong.mean(axis=1)))
        chosen = ", ".join(f"{key} {value:g}" for key, value in method.settings()[best].items())
        each = left_out(wrong)
        yield Figure(f"{name}: mean total error, left out", float(each.mean()), "%", 3.7, "the bar")
        yield Figure(f"{name}: the same, given", float(wrong[best].mean()), "%", None, chosen)
        yield Figure(
            f"{name}: the same, harder copies",
            float(np.mean([100.0 * np.mean(method.mask(p, **method.settings()[best]) != g) for p, g in copies])),
            "%",
        )
        for sample, error, here in zip(SAMPLES, each, wrong[best], strict=True):
            yield Figure(f"{name}: sample {sample}, left out", float(error), "%", float(here), "given")
