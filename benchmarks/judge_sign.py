"""Whether a small upright plane is the plate of a sign: segments of simulated streets, and of a labelled recording.

Hard streets and streets of plates hold what looks like one (windows, fronts, vans, lorries, shop signs, boards);
streets of signs hold signs of all sizes. Of the recording only sweeps 0 to 3 are shown. Whether a post is seen below
is not asked, though all signs of the simulator have one: those on gantries and arms have none.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.drawn_streets import drawn_street, street_of_plates, street_of_signs
from benchmarks.hard_streets import hard_street
from benchmarks.judgement import Segments, with_unknown
from benchmarks.labelled_returns import CLASSES, labelled_returns
from benchmarks.labelled_scenes import labelled_scenes
from benchmarks.labelled_street import recording_folder
from benchmarks.street_scores import NOT_JUDGED, SIGN
from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample
from roadscan.assets.kinds.sign import Plate, SignOptions, candidates_of
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from roadscan.simulate import Scene as Street

HARD: Final = (*range(700, 708), 712, 713, 715, 718, 726, 1000, 1001, 1002, 1004)
SIGNS: Final = range(80, 85)
PLATES: Final = range(600, 614)
DRAWN: Final = range(200, 205)
"""Seeds of hard streets, of streets of signs, of streets of plates and what is like them, and of plain ones, whose
parked cars are no signs either."""
SIGHT: Final = ("open_more", "open_less", "open_top", "open_below", "backed", "level")
"""Features of sight lines, which clouds without a trajectory do not tell."""
SPOT_DEG: Final = 0.17
_RECORDED_WEIGHT: Final = 4.0
"""A segment of the recording counts as much as so many of simulated streets."""
_AROUND_M, _STEP_M = 30.0, 10.0
"""Margin around the drive, and the step of the square's corners (m)."""
FIT: Final = {
    "rounds": 160, "num_leaves": 7, "min_data_in_leaf": 10, "feature_fraction": 0.4,
    "increasing": ("bright_median", "bright_high", "filled", "open_more", "open_less", "open_top", "open_below"),
    "decreasing": ("residual_m", "beside", "behind", "vehicle", "misfit", "passed", "tilt", "backed", "level"),
}  # fmt: skip


def segments(folder: Path) -> Iterator[Segments]:
    """Candidates of each street, and of each square of the recording."""
    streets = [(f"hard {seed}", hard_street(seed)) for seed in HARD]
    streets += [(f"signs {seed}", street_of_signs(seed, divergence_deg=SPOT_DEG)) for seed in SIGNS]
    streets += [(f"plates {seed}", street_of_plates(seed)) for seed in PLATES]
    streets += [(f"drawn {seed}", drawn_street(seed)) for seed in DRAWN]
    found = [of_street(name, street) for name, street in streets]
    for number, (scene, labels) in enumerate(labelled_scenes(recording_folder(), folder / "sign-0-3", range(4))):
        found += of_recording(f"square {number}", scene, labels)
    yield from with_unknown((one for one in found if len(one.true)), SIGHT)


def of_street(name: str, street: Street) -> Segments:
    """Candidates of a simulated street: true are those most of whose returns met a plate."""
    seen = labelled_returns(street)
    way = seen.drive_xyh_m[:, :2]
    corners = np.concatenate([np.floor((way.min(axis=0) - _AROUND_M) / _STEP_M),
                              np.ceil((way.max(axis=0) + _AROUND_M) / _STEP_M)]) * _STEP_M  # fmt: skip
    box = Box(*corners.tolist())
    kept = np.flatnonzero(box.holds(seen.returns.x_m, seen.returns.y_m))
    scene = make_scene(seen.returns.at(kept), box, box, seen.drive_xyh_m)
    return of_simulated(name, calibrated_scene(scene, gains_of([intensity_sample(scene)])), seen.class_id[kept])


def of_simulated(name: str, scene: Scene, class_id: npt.NDArray[Any]) -> Segments:
    """Candidates of a simulated scene with the class of each return."""
    found = candidates_of(scene, SignOptions())
    share = np.array([np.mean(class_id[one.rows] == CLASSES.index("sign")) for one in found])
    return _together(name, "simulated", found, share > 0.5, np.where(np.abs(share - 0.35) < 0.15, 0.0, 1.0))


def of_recording(name: str, scene: Scene, labels: npt.NDArray[np.uint8]) -> Iterator[Segments]:
    """Candidates of a square of the recording that those who labelled judged."""
    found = [one for one in candidates_of(scene, SignOptions()) if bool(scene.tile.holds(*one.middle_m[:2]))]
    found = [one for one in found if np.isin(labels[one.rows], NOT_JUDGED).mean() <= 0.5]
    if found:
        true = np.array([np.mean(labels[one.rows] == SIGN) > 0.5 for one in found])
        yield _together(name, "semantic_kitti_00", found, true, np.full(len(found), _RECORDED_WEIGHT))


def _together(name: str, source: str, found: list[Plate], true: Any, weight: Any) -> Segments:
    kept = np.flatnonzero(weight > 0.0)
    names = found[0].features if found else ()
    columns = {n: np.array([found[k].features[n] for k in kept]) for n in names}
    return Segments(name, source, columns, np.asarray(true)[kept], np.asarray(weight, np.float64)[kept])
