"""Question `kerb`: does a node of an edge lie at a kerb? Feet of walls and hedges, ruts, beds, rings and steps between
sweeps look alike."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.edge_scenes import JudgedScene, judged_scenes
from benchmarks.judgement import Segments, with_unknown
from roadscan.assets.edges.find import node_features, open_edges

UNKNOWN: Final = ("crossing", "outward")
"""Features that a cloud without drives and places of its sensor does not tell."""
FIT: Final = {
    "min_data_in_leaf": 40, "num_leaves": 6, "rounds": 100,
    "increasing": ("seen_low", "covered", "significance", "length_m", "evidence", "crossing",
                   "within_rings"),
    "decreasing": ("stands_high", "stands_low", "grows_low"),
}  # fmt: skip


def segments(folder: Path) -> Iterator[Segments]:
    """Nodes of the edges of all scenes, by group."""
    for one in judged_scenes(folder):
        yield from with_unknown(of_scene(one), UNKNOWN)


def of_scene(one: JudgedScene) -> Iterator[Segments]:
    """Nodes of one scene within its tile, by group. A node counts as the share of a metre that it stands for."""
    edges = open_edges(one.scene)
    if not edges:
        return
    features = node_features(one.scene, edges)
    x, y = (np.concatenate([getattr(e.nodes, name) for e in edges]) for name in ("x_m", "y_m"))
    true, weight = one.kerb(x, y)
    use = (weight > 0.0) & one.scene.tile.holds(x, y) & np.concatenate([e.seen for e in edges])
    group = one.groups(x, y)
    for name in np.unique(group[use]):
        own = use & (group == name)
        held = {k: v[own] for k, v in features.items()}
        yield Segments(str(name), one.source, held, true[own], weight[own])
