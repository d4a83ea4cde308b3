"""The question of the judge `drain`: is a spot that is a cover or a drain a drain? The spots of `judge_cover.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.judge_cover import spots_with_types
from benchmarks.judgement import Segments


def segments(folder: Path) -> Iterator[Segments]:
    """Covers and drains of each street, with whether they are drains."""
    for one in spots_with_types():
        if (things := things_of(one)) is not None:
            yield things


def things_of(one: Segments) -> Segments | None:
    """The spots of a street that are a cover or a drain; None where there is none."""
    either = one.true != "none"
    if not either.any():
        return None
    features = {name: values[either] for name, values in one.features.items()}
    return Segments(one.group, one.source, features, one.true[either] == "drain", one.weight[either])
