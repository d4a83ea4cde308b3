"""Draw assets of each kind as a recorded and a simulated street show them: ``docs/pictures/assets-kinds.png``.

The labelled street of SemanticKITTI (through ``ROADSCAN_DATA``) and a short simulated one with a thing of each kind; of
each kind that object which is most probable, as returns in the colours of their classes. Signs of the recorded street
are cut out of its pictures. Run from the repository: ``python docs/asset_kind_pictures.py``.
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

from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample  # noqa: E402
from roadscan.assets.kind import AssetObject, Marked, asset_kinds  # noqa: E402
from roadscan.assets.make_scene import make_scene  # noqa: E402
from roadscan.assets.object_table import reference_point  # noqa: E402
from roadscan.assets.pictures.readers.sign import SignReader  # noqa: E402
from roadscan.assets.scene import Box, Scene  # noqa: E402
from roadscan.jobs.assets.evidence import marked_classes  # noqa: E402
from roadscan.products.assets.thumbnails import EDGE_PX, drawn_from_above, drawn_from_side, fitted  # noqa: E402
from roadscan.simulate.scene import Scene as StreetScene  # noqa: E402
from tests.assets.scenes import recordings_folder, semantic_kitti_scene  # noqa: E402
from tests.assets.streets import street  # noqa: E402
from tests.assets.upright.scene import ROADSIDE  # noqa: E402

UInt8 = npt.NDArray[np.uint8]

FILE: Final = ROOT / "docs" / "pictures" / "assets-kinds.png"
PER_ROW: Final = 4
TITLE_PX: Final = 22
FOCAL, CENTRE = 718.856, (607.1928, 185.2157)
CAMERA_FROM_VELODYNE: Final = np.array(
    [
        [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03, -1.198459927713e-02],
        [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01, -5.403984729748e-02],
        [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03, -2.921968648686e-01],
    ]
)


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
    """The most probable object that returns show; a dark field where there is none."""
    for one in sorted(objects, key=lambda o: (-o.probability, reference_point(o.geometry)))[:8]:
        picture = drawn(one, points)
        if picture is not None:
            return picture
    return np.full((EDGE_PX, EDGE_PX, 3), (24, 26, 32), np.uint8)


def recorded_cut_out(objects: Sequence[AssetObject]) -> UInt8 | None:
    """The first picture of the recorded street around the sign nearest to its camera."""
    folder = recordings_folder() / "semantic_kitti_00"
    best: tuple[float, UInt8] | None = None
    poses = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    for number in range(6):
        pose = poses[number, 2:14].reshape(3, 4)
        grey = cv2.imread(str(folder / "image_0" / f"{number:06d}.png"), cv2.IMREAD_COLOR)
        for one in objects:
            outline = SignReader().outline_m(one)
            if outline is None:
                continue
            velodyne = (outline - pose[:, 3]) @ pose[:, :3]
            camera = velodyne @ CAMERA_FROM_VELODYNE[:, :3].T + CAMERA_FROM_VELODYNE[:, 3]
            if camera[:, 2].min() < 2.0:
                continue
            pixel = FOCAL * camera[:, :2] / camera[:, 2:] + CENTRE
            low, high = np.floor(pixel.min(axis=0)).astype(int) - 12, np.ceil(pixel.max(axis=0)).astype(int) + 12
            if (low < 0).any() or high[0] > grey.shape[1] or high[1] > grey.shape[0]:
                continue
            distance = float(camera[0, 2])
            if best is None or distance < best[0]:
                cut = grey[low[1] : high[1], low[0] : high[0]].copy()
                best = distance, fitted(cut)
    return None if best is None else best[1]


def simulated_scene() -> Scene:
    """A short street with a thing of each upright kind, kerbs and paint."""
    made = StreetScene.model_validate(
        {
            "seed": 11, "length_m": 36.0, "passes": [{"lane": 2}], "roadside": ROADSIDE,
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
    low = np.floor([returns.x_m.min() / 10, returns.y_m.min() / 10]) * 10
    high = np.ceil([returns.x_m.max() / 10, returns.y_m.max() / 10]) * 10
    box = Box(*low.tolist(), *high.tolist())
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
        if name == "sign":
            left = recorded_cut_out(recorded[name])
            left = shown(recorded[name], recorded_points) if left is None else left
        pairs[f"{name}: recorded {len(recorded[name])}, simulated {len(simulated[name])}"] = (left, right)
    whole = page(pairs)
    small = cv2.resize(whole, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
    from PIL import Image

    Image.fromarray(small).quantize(96, method=Image.Quantize.FASTOCTREE).save(FILE, optimize=True)


if __name__ == "__main__":
    main()
