"""Draw what stands beside a recorded and a simulated street, seen from above: ``docs/pictures/assets_upright.png``.

The labelled street of SemanticKITTI (through ``ROADSCAN_DATA``) above, one pass of a simulated HDL-32E below. Run from
the repository: ``python docs/upright_pictures.py``.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, Final

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402

from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample  # noqa: E402
from roadscan.assets.kind import AssetObject, asset_kinds  # noqa: E402
from roadscan.assets.scene import Box, Scene  # noqa: E402
from tests.assets.scenes import semantic_kitti_scene  # noqa: E402
from tests.assets.upright.scene import simulated  # noqa: E402

LINES: Final = {
    "facade": "#8c564b",
    "wall": "#7f7f7f",
    "fence": "#ff7f0e",
    "guardrail": "#d62728",
    "barrier": "#d8b0a0",
}
POINTS: Final[dict[str, dict[str, Any]]] = {
    "tree": {"marker": "o", "s": 110, "facecolors": "none", "edgecolors": "#2e9e4f"},
    "pole": {"marker": "o", "s": 45, "color": "#1f77b4"},
    "lighting": {"marker": "*", "s": 130, "color": "#ff8c1a"},
    "signal": {"marker": "P", "s": 70, "color": "#1f4fb4"},
    "delineator": {"marker": "o", "s": 14, "color": "#8f8787"},
    "clearance": {"marker": "v", "s": 45, "color": "black"},
}


def objects_of(scene: Scene, name: str) -> list[AssetObject]:
    """Objects of a kind in one scene."""
    kind = asset_kinds()[name]
    options = kind.options()
    return list(kind.objects(kind.evidence(scene, options).pieces, options, {}))


def draw(axes: Any, scene: Scene, view: Box, title: str) -> None:
    """Returns that stand above the ground in grey, and all that was found of them."""
    import shapely

    scene = calibrated_scene(scene, gains_of([intensity_sample(scene)]))
    returns, corner = scene.returns, np.array(scene.returns.corner_m)
    high = np.flatnonzero((scene.above_ground_m > 1.0) & (scene.above_ground_m < 8.0))[::12]
    axes.scatter(returns.x_m[high], returns.y_m[high], s=0.1, color="#c4c4c4")
    axes.plot(scene.drive_xyh_m[:, 0], scene.drive_xyh_m[:, 1], ":", color="black", lw=1.0)
    for k, one in enumerate(objects_of(scene, "landscape_area")):
        ring = shapely.get_coordinates(one.geometry.exterior) - corner
        axes.fill(*ring.T, color="#9be08f", alpha=0.6, lw=0, label="Landscape area" if k == 0 else None)
    for name, colour in LINES.items():
        for k, one in enumerate(objects_of(scene, name)):
            line = shapely.get_coordinates(one.geometry) - corner
            axes.plot(*line.T, color=colour, lw=2.2, label=asset_kinds()[name].title if k == 0 else None)
    for name, look in POINTS.items():
        places = [(o.geometry.x, o.geometry.y) for o in objects_of(scene, name)]
        if places:
            axes.scatter(*(np.array(places) - corner).T, label=asset_kinds()[name].title, zorder=3, **look)
    for k, one in enumerate(objects_of(scene, "sign")):
        x, y = np.array([one.geometry.x, one.geometry.y]) - corner
        facing = math.radians(one.attributes["facing_deg"])
        east, north = math.sin(facing), math.cos(facing)
        axes.plot(
            [x - north, x + north], [y + east, y - east], color="#d62728", lw=3.0, label="Sign" if k == 0 else None
        )
        axes.annotate(
            "", (x + 1.6 * east, y + 1.6 * north), (x, y), arrowprops={"arrowstyle": "->", "color": "#d62728"}
        )
    axes.set(xlim=(view.x_min_m, view.x_max_m), ylim=(view.y_min_m, view.y_max_m), aspect="equal", xlabel="m")
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=7, ncol=2, loc="upper left")


def main() -> None:
    """Write the picture."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    figure, (above, below) = plt.subplots(2, 1, figsize=(9.0, 10.0), layout="constrained")
    recorded = "Recorded: eight sweeps of an HDL-64E in a town (SemanticKITTI 00)"
    draw(above, semantic_kitti_scene(60.0)[0], Box(-50.0, -30.0, 60.0, 36.0), recorded)
    draw(below, simulated()[0], Box(-16.0, -12.0, 50.0, 34.0), "Simulated: one pass of an HDL-32E at 58 km/h")
    file = ROOT / "docs" / "pictures" / "assets_upright.png"
    figure.savefig(file, dpi=90, metadata={"Software": None})
    with Image.open(file) as drawn:
        drawn.convert("RGB").quantize(64, method=Image.Quantize.FASTOCTREE).save(file, optimize=True)


if __name__ == "__main__":
    main()
