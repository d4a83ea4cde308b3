"""Whether the stated probabilities of assets mean what they say: objects of ten drawn streets against the truth.

The error is the mean distance between stated probability and share that is right, over ten bins (expected calibration
error). No weight of the stage was set on these ten streets.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.asset_scores import Judged, calibration_error, judged
from benchmarks.asset_streets import processed
from benchmarks.drawn_streets import drawn_street
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure

SEEDS: Final = range(10)
SETTINGS: Final = "classified = false\nbare_earth = false\nexports = []\n"


def figures(folder: Path) -> Iterator[Figure]:
    """The error over all objects, then each bin, then each kind."""
    objects: list[Judged] = []
    for seed in SEEDS:
        objects += judged_street(seed, bench_folder(folder))
    yield Figure("expected calibration error", calibration_error(objects), "", 0.05, "the bar")
    stated, right = np.array([o.probability for o in objects]), np.array([o.is_right for o in objects])
    for low in np.arange(0.5, 1.0, 0.1):
        own = (stated >= low) & (stated < low + 0.1 + 1e-9 * (low > 0.85))
        if own.any():
            what = f"right of {own.sum()} with {low:.1f} to {low + 0.1:.1f}"
            yield Figure(what, float(right[own].mean()), "", float(stated[own].mean()), "stated")
    for kind in sorted({o.kind for o in objects}):
        own = np.array([o.kind == kind for o in objects])
        yield Figure(f"right of {own.sum()} {kind}", float(right[own].mean()), "", float(stated[own].mean()), "stated")


def judged_street(seed: int, folder: Path) -> list[Judged]:
    """Objects of a drawn street."""
    return list(judged(processed(drawn_street(seed), folder / f"drawn-{seed}", settings=SETTINGS)))
