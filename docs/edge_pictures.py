"""Pictures of kerbs, road edges, sidewalks and medians on a recorded and a simulated street, for docs/assets.md.

The recorded one is SemanticKITTI 00 (Geiger et al. 2012, Behley et al. 2019; CC BY-NC-SA), found through ROADSCAN_DATA.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from PIL import Image

mpl.use("Agg")
import matplotlib.pyplot as plt

from roadscan.assets.edges.steps import raster_of
from roadscan.assets.kind import AssetKind, AssetObject
from roadscan.assets.kinds.kerb import Kerb
from roadscan.assets.kinds.median import Median
from roadscan.assets.kinds.road_edge import RoadEdge
from roadscan.assets.kinds.shoulder import Shoulder
from roadscan.assets.kinds.sidewalk import Sidewalk
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from tests.assets.edges.simulated import town_street
from tests.assets.scenes import semantic_kitti_returns

PICTURES = Path(__file__).parent / "pictures"
COLOURS = {"upright": "#d62728", "sloped": "#ff7f0e", "dropped": "#17becf"}


def objects_of(kind: AssetKind, scene: Scene, **others: list[AssetObject]) -> list[AssetObject]:
    """Objects of a kind in one scene."""
    options = kind.options()
    return list(kind.objects(kind.evidence(scene, options).pieces, options, others))


def draw(scene: Scene, box: Box, title: str, file: str, lane_lines: list[AssetObject]) -> None:
    """Heights of the ground in grey, and what was found on them."""
    kerbs, edges = objects_of(Kerb(), scene), objects_of(RoadEdge(), scene)
    areas = [("sidewalk", "#2ca02c", objects_of(Sidewalk(), scene)), ("median", "#e377c2", objects_of(Median(), scene))]
    areas.append(("shoulder", "#9467bd", objects_of(Shoulder(), scene, road_edge=edges, lane_line=lane_lines)))
    raster, window = raster_of(scene), scene.window
    figure, axes = plt.subplots(figsize=(9.0, 9.0 * (box.y_max_m - box.y_min_m) / (box.x_max_m - box.x_min_m) + 0.4))
    extent = (window.x_min_m, window.x_max_m, window.y_min_m, window.y_max_m)
    down, right = np.gradient(raster.height_m, raster.cell_m)
    axes.imshow(np.hypot(down, right), origin="lower", extent=extent, cmap="gray_r", vmin=0.0, vmax=0.8)
    for name, colour, found in areas:
        for k, one in enumerate(found):
            ring = np.array(one.geometry.exterior.coords)
            axes.fill(*ring[:, :2].T, color=colour, alpha=0.3, lw=0, label=name if k == 0 else None)
    for k, one in enumerate(edges):
        axes.plot(*line(one), color="black", lw=3.0, alpha=0.6, label="road edge" if k == 0 else None)
    for name, colour in COLOURS.items():
        for k, one in enumerate(kerb for kerb in kerbs if kerb.attributes["type"] == name):
            axes.plot(*line(one), color=colour, lw=1.6, label=f"kerb, {name}" if k == 0 else None)
    axes.set(xlim=(box.x_min_m, box.x_max_m), ylim=(box.y_min_m, box.y_max_m), title=title, xlabel="m", ylabel="m")
    axes.legend(loc="lower right", fontsize=8)
    figure.tight_layout()
    figure.savefig(PICTURES / file, dpi=80)
    plt.close(figure)
    with Image.open(PICTURES / file) as picture:
        picture.convert("RGB").quantize(48).save(PICTURES / file, optimize=True)


def line(one: AssetObject) -> Any:
    """Coordinates x and y of a line."""
    return np.array(one.geometry.coords)[:, :2].T


def recorded() -> None:
    """Eight labelled sweeps at a junction."""
    returns, _, drive = semantic_kitti_returns()
    box = Box(-30.0, -24.0, 30.0, 26.0)
    inside = box.holds(returns.x_m, returns.y_m)
    draw(make_scene(returns.at(inside), box, box, drive), box, "SemanticKITTI 00", "assets-edges-recorded.png", [])


def simulated() -> None:
    """A piece of the scene `urban_street`; its lane lines are those of the scene."""
    import shapely

    street = town_street(44.0, 3)
    station = np.arange(0.0, 44.0, 1.0)
    lines = []
    for offset in (-3.2, 3.2):
        places = street.surface.points_at(station, np.full(station.size, offset)) - street.corner_m
        lines.append(AssetObject(shapely.LineString(places), 0.02, 0.01, 0.9, 1, 1, 0, 1))
    east, north = np.concatenate([np.array(one.geometry.coords)[:, :2] for one in lines]).T
    box = Box(east.min() - 9.0, north.min() - 4.0, east.max() + 9.0, north.max() + 4.0)
    returns = street.street.returns
    inside = box.holds(returns.x_m, returns.y_m)
    scene = make_scene(returns.at(inside), box, box, street.street.drive)
    draw(scene, box, "urban_street, simulated HDL-32E", "assets-edges-simulated.png", lines)


if __name__ == "__main__":
    recorded()
    simulated()
