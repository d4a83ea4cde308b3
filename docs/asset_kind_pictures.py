"""Draw assets of each kind as a recorded and a simulated street show them: ``docs/pictures/assets-kinds.png``.

The labelled street of SemanticKITTI (through ``ROADSCAN_DATA``) and a short simulated one with a thing of each kind; of
each kind that object which is most probable, as returns in the colours of their classes. Run from the repository:
``python docs/asset_kind_pictures.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import numpy.typing as npt  # noqa: E402

from roadscan.assets.files.thumbnails import EDGE_PX, drawn_from_above, drawn_from_side  # noqa: E402
from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample  # noqa: E402
from roadscan.assets.kind import (  # noqa: E402
    AssetObject,
    Marked,
    asset_kinds,
    reference_point,
)
from roadscan.assets.make_scene import make_scene  # noqa: E402
from roadscan.assets.scene import Box, Scene  # noqa: E402
from roadscan.assets.tasks.evidence import marked_classes  # noqa: E402
from roadscan.simulate.scene import Scene as StreetScene  # noqa: E402
from tests.assets.scenes import semantic_kitti_scene  # noqa: E402
from tests.assets.streets import street  # noqa: E402
from tests.assets.upright.scene import ROADSIDE  # noqa: E402

UInt8 = npt.NDArray[np.uint8]

FILE: Final = ROOT / "docs" / "pictures" / "assets-kinds.png"
PER_ROW: Final = 4
TITLE_PX: Final = 22


def found_in(scene: Scene) -> tuple[dict[str, list[AssetObject]], tuple[Any, Any, Any]]:
    """Objects of each kind, and the returns (place, class, intensity) with the classes that kinds gave them."""
    seen = calibrated_scene(scene, gains_of([intensity_sample(scene)]))
    objects: dict[str, list[AssetObject]] = {}
    marked: list[Marked] = []
    waiting = dict(asset_kinds())
    while waiting:
        name = next(n for n, kind in waiting.items() if not set(kind.after) & set(waiting))
        kind = waiting.pop(name)
        options = kind.options()
        evidence = kind.evidence(seen, options)
        marked += evidence.marked
        others = {other: objects.get(other, []) for other in kind.after}
        objects[name] = list(kind.objects(evidence.pieces, options, others))
    r, corner = scene.returns, scene.returns.corner_m
    place = np.column_stack([r.x_m + corner[0], r.y_m + corner[1], r.height_m])
    return objects, (place, marked_classes(scene, marked), r.intensity)


def drawn(one: AssetObject, points: tuple[Any, Any, Any]) -> UInt8 | None:
    """An object's returns: upright things from the side, others from above."""
    if one.geometry.geom_type != "Point":
        return drawn_from_above(points, one.geometry)
    east, north, height = reference_point(one.geometry)
    above, values = 0.0, one.attributes
    if values.get("plate_height_m"):
        above = (values.get("clearance_m") or 0.0) + values["plate_height_m"] / 2
    return drawn_from_side(points, (east, north, height - above), values.get("asset_height_m") or 3.0 + above / 2)


def shown(objects: Sequence[AssetObject], points: tuple[Any, Any, Any]) -> UInt8:
    """The most probable object that returns show; a light field where there is none."""
    for one in sorted(objects, key=lambda o: (-o.probability, reference_point(o.geometry)))[:8]:
        picture = drawn(one, points)
        if picture is not None:
            return picture
    none = np.full((EDGE_PX, EDGE_PX, 3), 235, np.uint8)
    cv2.putText(none, "none", (84, 114), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (120, 120, 120), 1, cv2.LINE_AA)
    return none


def simulated_scene() -> Scene:
    """A short street with a thing of each upright kind, kerbs and paint."""
    roadside: dict[str, Any] = dict(ROADSIDE)
    boxes = [
        *roadside["boxes"], {"station_m": 30.0, "offset_m": -6.6, "length_m": 10.0, "width_m": 0.3, "height_m": 0.9},
        {"station_m": 15.2, "offset_m": -6.6, "length_m": 2.0, "width_m": 0.9, "height_m": 0.9},
    ]  # fmt: skip
    signs = [{"station_m": 26.0, "offset_m": 6.0, "shape": "triangle", "width_m": 0.9}]
    made = StreetScene.model_validate(
        {
            "seed": 11, "length_m": 36.0, "passes": [{"lane": 2}],
            "roadside": {**roadside, "boxes": boxes, "signs": signs},
            "road": {"lanes": 2, "verge_width_m": 12.0, "verge_slope": 0.02, "lead_m": 70.0,
                     "shoulder_width_m": 2.0,
                     "kerbs": [{"side": "right", "height_m": 0.12}],
                     "markings": [{"offset_m": 0.0, "dash_m": 3.0, "gap_m": 3.0}, {"offset_m": 3.3},
                                  {"offset_m": -3.3}],
                     "stop_bars": [{"station_m": 14.0, "from_m": 0.1, "to_m": 3.2}],
                     "crosswalks": [{"station_m": 19.0, "from_m": -3.0, "to_m": 3.0}]},
            "vehicle": {"speed_m_per_s": 16.0, "standstill_s": 0.0}, "profilers": {"on": False},
            "lidar": {"range_max_m": 30.0}, "noise": {"lidar_range_m": 0.015, "intensity": 5.0, "dropout": 0.002},
        }
    )  # fmt: skip
    seen = street(made)
    returns = seen.returns
    low, high = (10.0 * np.floor(v / 10.0 + k) for v, k in ((returns.x_m.min(), 0), (returns.x_m.max(), 1)))
    south, north = (10.0 * np.floor(v / 10.0 + k) for v, k in ((returns.y_m.min(), 0), (returns.y_m.max(), 1)))
    box = Box(float(low), float(south), float(high), float(north))
    return make_scene(returns, box, box, seen.drive_xyh_m)


def titled(title: str, pair: Sequence[UInt8]) -> UInt8:
    """Two thumbnails below a title."""
    both = np.hstack([pair[0], np.full((EDGE_PX, 2, 3), 255, np.uint8), pair[1]])
    head = np.full((TITLE_PX, both.shape[1], 3), 255, np.uint8)
    cv2.putText(head, title, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (20, 20, 20), 1, cv2.LINE_AA)
    return np.vstack([head, both])


def page(titles: Mapping[str, Sequence[UInt8]]) -> UInt8:
    """All kinds, some in a row."""
    tiles = [titled(title, pair) for title, pair in titles.items()]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % PER_ROW)
    gap = np.full((tiles[0].shape[0], 10, 3), 255, np.uint8)
    rows = []
    for at in range(0, len(tiles), PER_ROW):
        parts = [part for one in tiles[at : at + PER_ROW] for part in (one, gap)][:-1]
        rows.append(np.hstack(parts))
    return np.vstack(rows)


def main() -> None:
    """Write the picture."""
    recorded, recorded_points = found_in(semantic_kitti_scene(40.0)[0])
    simulated, simulated_points = found_in(simulated_scene())
    pairs = {}
    for name in asset_kinds():
        left, right = shown(recorded[name], recorded_points), shown(simulated[name], simulated_points)
        pairs[f"{name}: recorded {len(recorded[name])}, simulated {len(simulated[name])}"] = (left, right)
    whole = page(pairs)
    small = cv2.resize(whole, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
    from PIL import Image

    Image.fromarray(small).quantize(96, method=Image.Quantize.FASTOCTREE).save(FILE, optimize=True)


if __name__ == "__main__":
    main()
