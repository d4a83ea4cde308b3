"""Landscape areas and kerbs on streets drawn with beds, as three lidars see them: found and right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from benchmarks.asset_scores import area_figures, line_figures
from benchmarks.asset_streets import processed, seen_by
from benchmarks.bed_streets import motorway_with_beds, town_partly_driven_twice, town_with_beds
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure

SEEDS: Final = (11, 12)
MODELS: Final = ("HDL-32E", "VLP-16", "OS1-128")
_SETTINGS: Final = "kinds = ['landscape_area', 'kerb']\nbare_earth = false\nexports = []\n"


def figures(folder: Path) -> Iterator[Figure]:
    """Figures of each street and lidar."""
    for seed in SEEDS:
        for name, scene in (
            ("town", town_with_beds(seed)),
            ("motorway", motorway_with_beds(seed)),
            ("town partly driven twice", town_partly_driven_twice(seed)),
        ):
            for model in MODELS:
                place = bench_folder(folder) / f"beds-{name}-{seed}-{model}"
                street = processed(seen_by(model, scene), place, settings=_SETTINGS)
                for figure in (*line_figures(street), *area_figures(street)):
                    if figure.what.startswith(("landscape_area", "kerb")):
                        yield replace(figure, what=f"{name} {seed}, {model}, {figure.what}")
