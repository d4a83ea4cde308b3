"""Whether a stretch of an upright surface belongs to a boundary that people made: a wall, a fence, a rail, a barrier.

Segments are stretches of a metre of hard streets, of plain ones, and of a labelled recording, of which only sweeps 0 to
3 are shown. `judge_fence.py` asks of the simulated ones that do which let beams through.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.drawn_streets import drawn_street
from benchmarks.hard_streets import hard_street
from benchmarks.judgement import Segments
from benchmarks.labelled_returns import CLASSES, LabelledReturns, labelled_returns
from benchmarks.labelled_scenes import labelled_scenes
from benchmarks.labelled_street import recording_folder
from benchmarks.street_scores import FENCE, NOT_JUDGED
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.boundaries import features_of
from roadscan.assets.upright.lines import chain_of_panel
from roadscan.assets.upright.panels import panels_of
from roadscan.simulate import Scene as Street

HARD: Final = (*range(12), *range(700, 705))
DRAWN: Final = range(200, 208)
OVERGROWN: Final = range(720, 732)
"""Seeds of hard streets, of plain ones, and of hard ones with hedges on their fences and walls."""
FIT: Final = {"rounds": 150}
_OTHER, _SOLID, _POROUS = 0, 1, 2
_SURE: Final = 0.7
"""Stretches of which a smaller share of the returns met one kind are left out."""
_LEAST: Final = 8.0
"""Stretches with fewer returns are left out."""
_RECORDED_WEIGHT: Final = 0.5
"""A stretch of the recording counts so much of one of a simulated street: few of its 250 m are a fence."""
_AROUND_M, _STEP_M = 30.0, 10.0
"""Margin around the drive, and the step of the square's corners (m)."""


def segments(folder: Path) -> Iterator[Segments]:
    """Stretches of each street, and of each square of the recording."""
    for name, street in streets():
        features, kind, length = of_street(street)
        yield Segments(name, "simulated", features, kind != _OTHER, length)
    for number, (scene, labels) in enumerate(labelled_scenes(recording_folder(), folder / "boundary-0-3", range(4))):
        yield from of_recording(f"square {number}", scene, labels)


def streets() -> Iterator[tuple[str, Street]]:
    """Simulated streets, with their names."""
    yield from ((f"hard {seed}", hard_street(seed)) for seed in HARD)
    yield from ((f"overgrown {seed}", overgrown(hard_street(seed))) for seed in OVERGROWN)
    yield from ((f"drawn {seed}", drawn_street(seed)) for seed in DRAWN)


def overgrown(street: Street) -> Street:
    """The street with hedges behind most of its fences and low walls, which they stand on, touch, or rise over."""
    random = np.random.default_rng(street.seed)
    hedges = [one.model_dump() for one in street.roadside.hedges]
    for one in (*street.roadside.fences, *street.roadside.walls):
        behind = getattr(one, "thickness_m", 0.03) + random.uniform(-0.1, 0.25)
        height, width = one.height_m + random.uniform(-0.2, 1.3), random.uniform(0.4, 1.2)
        if random.random() < 0.6 and one.height_m < 2.0:
            span = {"start_m": one.start_m, "end_m": one.end_m, "height_m": max(height, 0.4), "width_m": width}
            hedges.append({**span, "offset_m": one.offset_m + np.sign(one.offset_m) * behind, "ragged_m": 0.1,
                           "passing": float(np.exp(random.uniform(np.log(0.005), np.log(0.3))))})  # fmt: skip
    return street.changed(roadside={"hedges": hedges})


def of_street(street: Street) -> tuple[dict[str, Any], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Features of the stretches (k,) of a simulated street, what they are, and their lengths (m)."""
    seen = labelled_returns(street)
    scene, kept = scene_of(seen)
    return _stretches(scene, kinds_of(street, seen)[kept], 3)


def scene_of(seen: LabelledReturns) -> tuple[Scene, npt.NDArray[np.int64]]:
    """The scene about a drive, and the returns that are in it."""
    way = seen.drive_xyh_m[:, :2]
    corners = np.concatenate([np.floor((way.min(axis=0) - _AROUND_M) / _STEP_M),
                              np.ceil((way.max(axis=0) + _AROUND_M) / _STEP_M)]) * _STEP_M  # fmt: skip
    box = Box(*corners.tolist())
    kept = np.flatnonzero(box.holds(seen.returns.x_m, seen.returns.y_m))
    return make_scene(seen.returns.at(kept), box, box, seen.drive_xyh_m), kept


def kinds_of(street: Street, seen: LabelledReturns) -> npt.NDArray[np.int64]:
    """What each return (n,) met: a solid boundary, one that beams pass, or something else. Panels stop all beams."""
    objects = seen.objects
    fences = objects[objects.kind.isin(["fence", "gate"])].object_id
    lets_pass = [one.style != "panels" for one in street.roadside.fences]
    porous = [number for number, passes in zip(fences, lets_pass, strict=True) if passes]
    made = np.isin(seen.class_id, [CLASSES.index("wall"), CLASSES.index("fence")])
    return np.where(made, np.where(np.isin(seen.object_id, porous), _POROUS, _SOLID), _OTHER)


def of_recording(name: str, scene: Scene, labels: npt.NDArray[np.uint8]) -> Iterator[Segments]:
    """Stretches of a square of the recording that those who labelled judged."""
    features, label, length = _stretches(scene, labels.astype(np.int64), 256, scene.tile)
    judged = ~np.isin(label, NOT_JUDGED)
    if judged.any():
        features = {key: values[judged] for key, values in features.items()}
        yield Segments(name, "semantic_kitti_00", features, label[judged] == FENCE, _RECORDED_WEIGHT * length[judged])


def _stretches(
    scene: Scene, kind: npt.NDArray[np.int64], kinds: int, inside: Box | None = None
) -> tuple[dict[str, Any], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Features of the stretches of a scene, what most of the returns of each are, and its length (m)."""
    parts, told, length = [], [np.zeros(0, np.int64)], [np.zeros(0)]
    for panel in panels_of(scene):
        chain = chain_of_panel(panel)
        counts = np.zeros((panel.returns.size, kinds))
        np.add.at(counts, (panel.stretch, kind[panel.rows]), 1.0)
        kept = (counts.max(axis=1) >= _SURE * counts.sum(axis=1)) & (panel.returns >= _LEAST)
        middle = (panel.xy_m[1:] + panel.xy_m[:-1]) / 2
        kept &= True if inside is None else inside.holds(*middle.T)
        parts.append({name: values[kept] for name, values in features_of(chain).items()})
        told.append(counts.argmax(axis=1)[kept])
        length.append(chain.values["length_m"][kept])
    together = {name: np.concatenate([one[name] for one in parts]) for name in parts[0]} if parts else {}
    return together, np.concatenate(told), np.concatenate(length)
