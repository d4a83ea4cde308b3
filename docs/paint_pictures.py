"""Draw lane lines and markings over the contrast that they were found in: ``docs/pictures/paint.png``.

The labelled street of SemanticKITTI (through ``ROADSCAN_DATA``) on the left, a stretch of the simulated town street on
the right. Run from the repository: ``python docs/paint_pictures.py``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample  # noqa: E402
from roadscan.assets.kind import asset_kinds  # noqa: E402
from roadscan.assets.paint.detection import paint_of  # noqa: E402
from roadscan.assets.scene import Box, Scene  # noqa: E402
from tests.assets.scenes import semantic_kitti_scene  # noqa: E402
from tests.assets.simulated_streets import street  # noqa: E402

COLOURS = {"lane_line": "#e8590c", "road_marking": "#1c7ed6"}


def draw(axes: Any, scene: Scene, view: Box, title: str) -> None:
    """Contrast in grey, lines and outlines of markings over it."""
    import shapely

    scene = calibrated_scene(scene, gains_of([intensity_sample(scene)]))
    contrast, window = paint_of(scene).contrast.mean, scene.window
    extent = (window.x_min_m, window.x_max_m, window.y_min_m, window.y_max_m)
    axes.imshow(contrast, cmap="gray", vmin=-0.4, vmax=1.0, origin="lower", extent=extent, interpolation="nearest")
    for name, colour in COLOURS.items():
        kind = asset_kinds()[name]
        options = kind.options()
        for one in kind.objects(kind.evidence(scene, options).pieces, options, {}):
            shape = one.geometry if name == "lane_line" else one.geometry.exterior
            xy = shapely.get_coordinates(shape) - scene.returns.corner_m
            axes.plot(*xy.T, color=colour, linewidth=1.2)
    axes.set_xlim(view.x_min_m, view.x_max_m)
    axes.set_ylim(view.y_min_m, view.y_max_m)
    axes.set_title(title, fontsize=8)
    axes.tick_params(labelsize=6)


def main() -> None:
    """Write the picture."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.6), layout="constrained")
    draw(left, semantic_kitti_scene(40.0)[0], Box(-13.0, -6.0, 5.0, 12.0), "recorded (SemanticKITTI 00)")
    town = street("urban_street", 100.0, 20.0).scene
    draw(right, town, town.tile, "simulated (urban_street)")
    file = ROOT / "docs" / "pictures" / "paint.png"
    figure.savefig(file, dpi=90, metadata={"Software": None})
    with Image.open(file) as drawn:
        drawn.convert("RGB").quantize(64, method=Image.Quantize.FASTOCTREE).save(file, optimize=True)


if __name__ == "__main__":
    main()
