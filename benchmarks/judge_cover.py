"""The question of the judge `cover`: is a spot in the road a cover or a drain? Spots of simulated streets.

Hard streets hold what looks like them: patches, wet places, arrows and dashes, leaves in the gutter, kerbs, feet of
things that stand. The labelled recording knows no covers
and is not asked.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.judge_wire import parts_of, streets
from benchmarks.judgement import Segments
from benchmarks.labelled_returns import LabelledReturns
from roadscan.assets.kinds.cover import Spot, spots_of

_TYPES: Final = ("cover", "drain")
_SURE: Final = 0.6
"""A spot is a thing when this share of its returns met it, and it holds this share of the thing's returns."""


def segments(folder: Path) -> Iterator[Segments]:
    """Spots of each street, with whether they are a cover or a drain."""
    for one in spots_with_types():
        yield replace(one, true=one.true != "none")


def spots_with_types() -> Iterator[Segments]:
    """Spots of each street, as the whole drive and as a part of it sees it, with what they are."""
    for name, seen in streets():
        for scene, rows in parts_of(seen):
            yield from of_spots(name, spots_of(scene), seen, rows)


def of_spots(group: str, spots: list[Spot], seen: LabelledReturns, rows: npt.NDArray[np.int64]) -> Iterator[Segments]:
    """The spots of a scene whose returns are `rows` of a street, with what they are."""
    kind, thing = seen.kind[rows], seen.object_id[rows]
    told, types = [], []
    for one in spots:
        numbers, counts = np.unique(thing[one.rows], return_counts=True)
        most = int(numbers[counts.argmax()])
        name = seen.kinds[int(np.bincount(kind[one.rows]).argmax())]
        share = counts.max() / one.rows.size
        whole = counts.max() / max(int(np.count_nonzero(thing == most)), 1)
        if name not in _TYPES:
            told.append(one)
            types.append("none")
        elif share >= _SURE and whole >= _SURE:
            told.append(one)
            types.append(name)
    if told:
        columns = {n: np.array([one.features[n] for one in told]) for n in told[0].features}
        yield Segments(group, "simulated", columns, np.array(types), np.ones(len(told)))
