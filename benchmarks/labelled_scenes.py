"""Scenes of a labelled recording with the label of each return, as the stage `assets` makes them of a user's survey."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks.labelled_street import labelled_street
from roadscan.assets.intensity import calibrated_scene
from roadscan.assets.scene import Scene, Statistics
from roadscan.assets.tasks.gains import current_gains, plan_gains
from roadscan.assets.tasks.load_returns import load_squares, scene_of
from roadscan.assets.tasks.plan import plan_assets
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session

_SAME_M = 0.003  # A return of a scene is the recorded one that lies so near (m): the store rounds to 1 mm.


def labelled_scenes(
    recording: Path, folder: Path, sweeps: Iterable[int]
) -> Iterator[tuple[Scene, npt.NDArray[np.uint8]]]:  # fmt: skip
    """Scenes of all squares of some sweeps, with the label (n,) of each return; 0 where it is not known."""
    street = labelled_street(recording, folder, sweeps)
    session = Session.open(folder / "SURVEY.toml")
    plan = plan_assets(plan_of(session), footprints_of(session))
    shared, store = current_gains(plan_gains(plan), session.manifest), plan.survey.store
    gains = None if shared is None else shared.read_gains(store)
    statistics = Statistics() if shared is None else shared.read_statistics(store)
    tree = cKDTree(street.places_m)
    for squares in plan.blocks(list(plan.keys)):
        for one in load_squares(plan.load(squares)):
            if not len(one.returns):
                continue
            scene = scene_of(plan.grid, one, plan.config.ground, statistics)
            scene = scene if gains is None else calibrated_scene(scene, gains)
            r = scene.returns
            places = np.column_stack([r.x_m + r.corner_m[0], r.y_m + r.corner_m[1], r.height_m])
            away, at = tree.query(places, distance_upper_bound=_SAME_M)
            known = np.append(street.labels, np.uint8(0))[at]
            yield scene, np.where(np.isfinite(away), known, np.uint8(0)).astype(np.uint8)
