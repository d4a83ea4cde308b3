"""What the stage `assets` finds on whole simulated streets, beside the bars that were asked for.

Poses are exact: their errors are a matter of the adjustment. What lies within 4 m of an end is not judged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.asset_scores import figures_of
from benchmarks.asset_streets import motorway, processed, town
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure


def figures(folder: Path) -> Iterator[Figure]:
    """The town street in both directions, then the motorway in two of its lanes."""
    for name, scene in (("town", town()), ("motorway", motorway())):
        for figure in figures_of(processed(scene, bench_folder(folder) / f"assets-{name}")):
            yield replace(figure, what=f"{name}, {figure.what}", against="" if figure.other is None else "the bar")
