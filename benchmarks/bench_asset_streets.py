"""What the stage `assets` finds on whole simulated streets, beside the bars that were asked for.

Poses are exact: their errors are a matter of the adjustment. What lies within 4 m of an end is not judged. Signs of all
sizes stand on other streets, which are drawn: how far off the sizes of those are that are found, also with wide beams.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.asset_scores import figures_of, sign_errors
from benchmarks.asset_streets import motorway, processed, seen_by, town
from benchmarks.drawn_streets import street_of_signs
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure
from roadscan.simulate import Scene

SIGNS_OF: Final = range(60, 72)
_SETTINGS: Final = "kinds = ['sign']\nclassified = false\nbare_earth = false\nexports = []\n"
_SPOT_DEG: Final = 0.17


def scenes() -> Iterator[tuple[str, Scene]]:
    """The town street in both directions, the motorway in two of its lanes, and parts of both as others see them."""
    yield "town", town()
    yield "motorway", motorway()
    for model in ("VLP-16", "OS1-128"):
        yield f"town, {model}", seen_by(model, town(100.0))
        yield f"motorway, {model}", seen_by(model, motorway(120.0))
    yield "town, HDL-32E upright", seen_by("HDL-32E", town(100.0), pitch_deg=0.0)


def figures(folder: Path) -> Iterator[Figure]:
    """Figures of whole streets, then of streets of signs."""
    for name, scene in scenes():
        for figure in figures_of(processed(scene, bench_folder(folder) / f"assets-{name}")):
            yield replace(figure, what=f"{name}, {figure.what}", against="" if figure.other is None else "the bar")
    yield from sizes_of_signs(folder, 0.0, "drawn signs")
    yield from sizes_of_signs(folder, _SPOT_DEG, f"drawn signs, spots of {_SPOT_DEG}°")


def sizes_of_signs(folder: Path, divergence_deg: float, name: str) -> Iterator[Figure]:
    """Errors of the sizes and places of drawn signs: median, 95 % and worst, and how many are within two σ."""
    found = []
    for seed in SIGNS_OF:
        scene = street_of_signs(seed, divergence_deg=divergence_deg)
        street = processed(scene, bench_folder(folder) / f"signs-{seed}-{divergence_deg}", settings=_SETTINGS)
        found += sign_errors(street)
    size, off, sigma = (np.array([getattr(one, key) for one in found]) for key in ("size_m", "centre_m", "sigma_m"))
    for what, values in (("size", size), ("centre", off)):
        for share, word in ((0.5, "median"), (0.95, "95 %"), (1.0, "worst")):
            yield Figure(f"{name}: {what} of {len(found)}, {word}", 1000 * float(np.quantile(values, share)), "mm")
    yield Figure(f"{name}: sizes within two σ", float(np.mean(size <= 2.0 * sigma)), "")
