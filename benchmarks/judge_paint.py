"""Question `paint`: is a component of bright cells paint? Patches, covers, faces of kerbs and gravel look alike."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.edge_scenes import JudgedScene, judged_scenes
from benchmarks.judgement import Segments
from roadscan.assets.paint.components import components_of, contrast_of
from roadscan.assets.paint.detection import component_features

FIT: Final = {"min_data_in_leaf": 25, "num_leaves": 6, "rounds": 120, "increasing": ("length_m", "slim", "evidence")}
"""A longer, slimmer or clearer component is never less probable: few streets have lines of 30 m."""
_FEWEST: Final = 5
"""Components with fewer judged returns do not count."""
_SHARE: Final = 0.4
"""A component is paint where this share of its judged returns is."""
_RECORDED_WEIGHT: Final = 6.0
"""A component of the recording counts as much as so many of simulated streets, of which there are 24 times as many."""


def segments(folder: Path) -> Iterator[Segments]:
    """Components of all scenes, by group."""
    for one in judged_scenes(folder):
        yield from of_scene(one)


def of_scene(one: JudgedScene) -> Iterator[Segments]:
    """Components of one scene within its tile, by group.

    A component counts as the square root of its area, a long one as its pieces do on average.
    """
    found = contrast_of(one.scene)
    components = components_of(found)
    if not components:
        return
    features = component_features(one.scene, found, components)
    x, y = (np.array([getattr(c, name).mean() for c in components]) for name in ("cell_x_m", "cell_y_m"))
    rows = [found.rows[c.near[c.inside]] for c in components]
    judged = [own[one.is_judged[own]] for own in rows]
    share = np.array([one.is_paint[own].mean() if own.size else 0.0 for own in judged])
    use = one.scene.tile.holds(x, y) & (np.array([own.size for own in judged]) >= _FEWEST)
    size = np.sqrt(features["area_m2"] / 0.1)
    group, counts = one.groups(x, y), 1.0 if one.source == "simulated" else _RECORDED_WEIGHT
    for name in np.unique(group[use]):
        own = use & (group == name)
        held = {k: v[own] for k, v in features.items()}
        yield Segments(str(name), one.source, held, share[own] >= _SHARE, counts * size[own])
