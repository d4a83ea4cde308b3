"""Lawns flush with the pavement, from what ``roadscan run`` wrote with default settings, with pictures and without.

Street 2 was looked at; 12 and 13 are only scored.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.labelled_street import run
from benchmarks.lawn_streets import drawn, score, with_and_without_pictures
from benchmarks.timing import Figure

STREETS: Final = {2: "looked at", 12: "only scored", 13: "only scored"}


def figures(folder: Path) -> Iterator[Figure]:
    """Each street, by returns alone and with pictures."""
    for seed, seen in STREETS.items():
        street = folder / f"lawns {seed}"
        for name, file in with_and_without_pictures(drawn(seed, street), folder):
            run(file)
            found, what = score(street, file), f"street {seed} ({seen}), {name}"
            yield Figure(f"{what}: lawn found", found.found, "")
            yield Figure(f"{what}: of what is found, right", found.right, "")
            if found.errors_m.size:
                yield Figure(f"{what}: edges, median error", 1000.0 * float(np.median(found.errors_m)), "mm")
                rms = float(np.sqrt(np.mean(np.square(found.errors_m))))
                yield Figure(f"{what}: edges, error (RMS)", 1000.0 * rms, "mm", 1000.0 * found.sigma_m, "stated")
