"""Edges between asphalt and flush sidewalks, from products of ``roadscan run`` by default, with pictures and without.

Streets 1 to 3 were looked at; the others are only scored.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.grey_streets import drawn, score
from benchmarks.labelled_street import run
from benchmarks.lawn_streets import with_and_without_pictures
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure

STREETS: Final = (
    (1, "HDL-32E", True), (2, "VLP-16", True), (1, "VLP-16", False), (3, "HDL-32E", False), (14, "HDL-32E", True),
    (15, "VLP-16", True), (16, "VLP-16", True), (14, "VLP-16", False),
)  # fmt: skip
"""Seed, lidar, and whether the street has an edge."""
LOOKED_AT: Final = {1, 2, 3}


def figures(folder: Path) -> Iterator[Figure]:
    """Each street, by returns alone and with pictures."""
    for seed, model, edge in STREETS:
        seen = "looked at" if seed in LOOKED_AT else "only scored"
        street = bench_folder(folder) / f"grey {seed} {model}{'' if edge else ' without an edge'}"
        for name, file in with_and_without_pictures(drawn(seed, model, street, edge), folder):
            run(file)
            found, what = score(street, file, edge), f"{street.name} ({seen}), {name}"
            yield Figure(f"{what}: length of edges found", found.length_m, "m", found.true_m, "m of edges")
            if edge:
                yield Figure(f"{what}: edges found within 0.15 m", found.near[0], "")
                yield Figure(f"{what}: edges found within 0.3 m", found.near[1], "")
                yield Figure(f"{what}: of the edges found, right within 0.3 m", found.right, "")
            if found.errors_m.size:
                rms = 1000.0 * float(np.sqrt(np.mean(np.square(found.errors_m))))
                stated = 1000.0 * float(np.sqrt(np.mean(np.square(found.sigmas_m))))
                yield Figure(f"{what}: place of edges within 0.5 m, error (RMS)", rms, "mm", stated, "stated")
