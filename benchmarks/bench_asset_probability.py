"""Whether the stated probabilities of assets mean what they say, and the curves that make them so.

Curves (`roadscan/assets/probabilities.py`) are fitted to the objects of some drawn streets. Others, which take no part
in that, are held against them: ten drawn ones, and the town and the motorway of `asset_streets`. The error is the mean
distance between stated probability and share that is right, over ten bins (expected calibration error).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import scipy.optimize
from scipy.special import expit, logit

from benchmarks.asset_scores import Judged, calibration_error, judged
from benchmarks.asset_streets import motorway, processed, town
from benchmarks.drawn_streets import drawn_street
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure
from roadscan.assets.kind import asset_kinds
from roadscan.assets.probabilities import CURVES, Curve

FITTED_ON: Final = range(100, 140)
HELD_OUT: Final = range(10)
SETTINGS: Final = "classified = false\nbare_earth = false\nexports = []\n"
_DOUBT: Final = 2.0
"""Weight of the squares of a curve's offset and of its slope less 1: few objects change it little."""


def figures(folder: Path) -> Iterator[Figure]:
    """Errors of the streets that are held out, each bin and kind of these, and the curves that the others speak for."""
    held = judged_streets(HELD_OUT, bench_folder(folder))
    yield Figure("expected calibration error of ten other drawn streets", calibration_error(held), "", 0.05, "the bar")
    for name, scene in (("town", town()), ("motorway", motorway())):
        own = list(judged(processed(scene, bench_folder(folder) / f"probability-{name}", settings=SETTINGS)))
        yield Figure(f"expected calibration error of {len(own)} objects, {name}", calibration_error(own), "")
    stated, right = _arrays(held)
    for low in np.arange(0.0, 1.0, 0.1):
        own_bin = (stated >= low) & (stated < low + 0.1 + 1e-9 * (low > 0.85))
        if own_bin.any():
            what = f"right of {own_bin.sum()} with {low:.1f} to {low + 0.1:.1f}"
            yield Figure(what, float(right[own_bin].mean()), "", float(stated[own_bin].mean()), "stated")
    for kind in sorted({o.kind for o in held}):
        of_kind = np.array([o.kind == kind for o in held])
        what = f"right of {of_kind.sum()} {kind}"
        yield Figure(what, float(right[of_kind].mean()), "", float(stated[of_kind].mean()), "stated")
    for group, curve in fitted(judged_streets(FITTED_ON, bench_folder(folder))).items():
        yield Figure(f"{group}: offset", curve.offset, "", CURVES[group].offset, "in force")
        yield Figure(f"{group}: slope", curve.slope, "", CURVES[group].slope, "in force")


def of_evidence(curve: Curve, stated: float) -> float:
    """Return the evidence's probability for the stated one."""
    return float(expit((logit(stated) - curve.offset) / curve.slope))


def judged_streets(seeds: Iterable[int], folder: Path) -> list[Judged]:
    """Objects of drawn streets."""
    found: list[Judged] = []
    for seed in seeds:
        found += judged(processed(drawn_street(seed), folder / f"drawn-{seed}", settings=SETTINGS))
    return found


def fitted(objects: Sequence[Judged]) -> dict[str, Curve]:
    """The curve of each group that objects speak for: the greatest likelihood, less a doubt about any change."""
    curves = {}
    for group in CURVES:
        own = [o for o in objects if asset_kinds()[o.kind].curve == group]
        evidence = np.array([of_evidence(CURVES[group], o.probability) for o in own])
        odds, right = np.log(evidence / (1.0 - evidence)), np.array([o.is_right for o in own], np.float64)

        def loss(line: npt.NDArray[np.float64], odds: object = odds, right: object = right) -> float:
            z = line[0] + line[1] * np.asarray(odds)
            unlikely = float(np.sum(np.logaddexp(0.0, z) - np.asarray(right) * z))
            return unlikely + 0.5 * _DOUBT * float(line[0] ** 2 + (line[1] - 1.0) ** 2)

        best = scipy.optimize.minimize(loss, np.array([0.0, 1.0]), bounds=[(None, None), (0.05, None)])
        curves[group] = Curve(*map(float, best.x))
    return curves


def _arrays(objects: Sequence[Judged]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Stated probability (n,) of objects, and whether they are right (n,)."""
    return np.array([o.probability for o in objects]), np.array([o.is_right for o in objects])
