"""What a compact thing on the ground is: segments of simulated streets, as a whole drive and as parts of it see them.

Hard streets hold what is no furniture and looks like it: planters, boards, meters, letter boxes, steps, hedges, vans,
people who stand. The labelled recording knows no types of furniture; all that its labels call vehicle, vegetation,
person, fence, building, pole or sign is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.drawn_streets import drawn_street, street_of_furniture
from benchmarks.hard_streets import hard_street
from benchmarks.judgement import Segments
from benchmarks.labelled_returns import LabelledReturns, labelled_returns, scene_about
from benchmarks.labelled_scenes import labelled_scenes
from benchmarks.labelled_street import recording_folder
from roadscan.assets.kinds.street_furniture import Compact, compact_things
from roadscan.simulate import Scene as Street

TYPES: Final = ("cabinet", "bin", "bench", "hydrant", "bus_shelter")
_TYPE: Final = {"litter_bin": "bin"}
"""Type of a simulated thing where it has another name."""
HARD: Final = range(19)
DRAWN: Final = range(200, 208)
"""Seeds of hard streets, and of plain ones, which hold none of these."""
FURNISHED: Final = range(400, 416)
"""Seeds of plain streets with much furniture."""
_NO_FURNITURE: Final = (*range(10, 33), 50, 51, 70, 71, 80, 81)
"""Labels of vehicles, people, buildings, fences, vegetation, trunks, poles and signs."""
_PART_S, _PARTS = 2.0, 3
"""Duration (s) and number of the parts of a drive that are also shown by themselves."""
_SURE: Final = 0.7
"""A segment is a thing when this share of its returns met it; with less than half it is something else."""
FIT: Final = {"rounds": 120}


def segments(folder: Path) -> Iterator[Segments]:
    """Compact things of each street, and of each square of the recording."""
    streets = ((HARD, "hard", hard_street), (DRAWN, "drawn", drawn_street),
               (FURNISHED, "furniture", street_of_furniture))  # fmt: skip
    for seeds, name, draw in streets:
        for seed in seeds:
            yield from of_street(f"{name} {seed}", draw(seed))
    for number, (scene, labels) in enumerate(labelled_scenes(recording_folder(), folder / "furniture-0-3", range(4))):
        things = compact_things(scene)
        known = [one for one in things if np.isin(labels[one.rows], _NO_FURNITURE).mean() > 0.8]
        if known:
            yield _together(f"square {number}", "semantic_kitti_00", known, ["none"] * len(known))


def of_street(name: str, street: Street) -> Iterator[Segments]:
    """Compact things of a simulated street, as the whole drive sees it and as parts of it do."""
    seen = labelled_returns(street)
    epochs = seen.returns.epoch_gps_ns
    first, last = int(epochs.min()), int(epochs.max())
    begins = [first + (last - first) * (2 * k + 1) // (2 * _PARTS) for k in range(_PARTS)]
    spans = [(first, last + 1), *((begin, begin + int(_PART_S * 1e9)) for begin in begins)]
    for begin, end in spans:
        rows = np.flatnonzero((epochs >= begin) & (epochs < end))
        if rows.size:
            yield from _of_part(name, seen, rows)


def _of_part(name: str, seen: LabelledReturns, rows: npt.NDArray[np.int64]) -> Iterator[Segments]:
    scene, kept = scene_about(seen, rows)
    found, types = [], []
    for one in compact_things(scene):
        kinds = seen.kind[kept[one.rows]]
        most = int(np.bincount(kinds).argmax())
        share, kind = float(np.mean(kinds == most)), seen.kinds[most]
        kind = _TYPE.get(kind, kind)
        if share >= _SURE or kind not in TYPES or share < 0.5:
            found.append(one)
            types.append(kind if share >= _SURE else "none")
    if found:
        yield _together(name, "simulated", found, types)


def _together(name: str, source: str, found: list[Compact], types: list[str]) -> Segments:
    columns = {n: np.array([one.features[n] for one in found]) for n in found[0].features}
    return Segments(name, source, columns, np.array(types), np.ones(len(found)))
