"""Whether a boundary lets beams through: stretches of simulated streets (`judge_boundary.py`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from benchmarks.judge_boundary import of_street, streets
from benchmarks.judgement import Segments

FIT: Final = {
    "rounds": 120,
    "increasing": ("passing", "passing_far", "passing_run", "missing", "missing_far", "missing_run"),
}


def segments(folder: Path) -> Iterator[Segments]:
    """Stretches of the boundaries of each street: true are those that are no wall, panel or rail."""
    for name, street in streets():
        features, kind, length = of_street(street)
        made = kind > 0
        if made.any():
            features = {key: values[made] for key, values in features.items()}
            yield Segments(name, "simulated", features, kind[made] == 2, length[made])
