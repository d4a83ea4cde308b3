"""The question of the judge `wire`: is a straight line in the air a wire? Spans of simulated and recorded streets.

Hard streets hold wires beside one another and through crowns, and what looks like them: edges of fronts, balconies,
branches, arms of lamps, gantries, bridges. In the labelled recording all that its labels know is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.drawn_streets import street_of_covers, street_of_lookalikes
from benchmarks.hard_streets import hard_street
from benchmarks.judgement import Segments
from benchmarks.labelled_returns import LabelledReturns, labelled_returns, scene_about
from benchmarks.labelled_scenes import labelled_scenes
from benchmarks.labelled_street import recording_folder
from roadscan.assets.kinds.wire import features_of, spans_of, thin_cubes
from roadscan.assets.scene import Scene

HARD: Final = range(26)
COVERED: Final = range(500, 516)
LOOKALIKES: Final = range(540, 556)
"""Seeds of hard streets, of streets with wires and covers, and of such with what is like them."""
_KNOWN: Final = (*range(10, 33), 50, 51, 70, 71, 80, 81)
"""Labels of what is no wire."""
_PART_S: Final = 1.5
"""Duration of the part of a drive that is also shown by itself (s)."""
_SURE: Final = 0.7
"""A span is a wire where this share of its returns met one; where less than a third did, it is none."""


def segments(folder: Path) -> Iterator[Segments]:
    """Spans of each street, as the whole drive and as a part of it sees it, and of each square of the recording."""
    for name, seen in streets():
        wire = (seen.kind == seen.kinds.index("wire")) if "wire" in seen.kinds else np.zeros(seen.kind.size, np.bool_)
        for scene, rows in parts_of(seen):
            yield from _of_scene(name, "simulated", scene, wire[rows].astype(np.float64))
    for number, (scene, labels) in enumerate(labelled_scenes(recording_folder(), folder / "furniture-0-3", range(4))):
        yield from _of_scene(
            f"square {number}", "semantic_kitti_00", scene, np.where(np.isin(labels, _KNOWN), 0.0, 0.5)
        )


def streets() -> Iterator[tuple[str, LabelledReturns]]:
    """Streets by name."""
    sorts = (("hard", HARD, hard_street), ("covers", COVERED, street_of_covers),
             ("lookalikes", LOOKALIKES, street_of_lookalikes))  # fmt: skip
    for name, seeds, draw in sorts:
        for seed in seeds:
            yield f"{name} {seed}", labelled_returns(draw(seed))


def parts_of(seen: LabelledReturns) -> Iterator[tuple[Scene, npt.NDArray[np.int64]]]:
    """Scenes of a street, of the whole drive and of a part of it, each with the rows of its returns."""
    epochs = seen.returns.epoch_gps_ns
    first, last = int(epochs.min()), int(epochs.max()) + 1
    for begin in (first, (first + last) // 2):
        rows = np.flatnonzero((epochs >= begin) & (epochs < (last if begin == first else begin + int(_PART_S * 1e9))))
        if rows.size:
            yield scene_about(seen, rows)


def _of_scene(group: str, source: str, scene: Scene, wire: npt.NDArray[np.float64]) -> Iterator[Segments]:
    pieces, held = thin_cubes(scene)
    spans = list(spans_of(pieces))
    share = np.array([wire[np.concatenate([held[k] for k in one.rows.tolist()])].mean() for one in spans])
    told = [features_of(one, pieces) for one, s in zip(spans, share, strict=True) if s >= _SURE or s < 1.0 / 3.0]
    if told:
        features = {name: np.array([one[name] for one in told]) for name in told[0]}
        true = share[(share >= _SURE) | (share < 1.0 / 3.0)] >= _SURE
        yield Segments(group, source, features, true, np.ones(true.size))
