"""Writes docs/pictures/imagery-points.png and imagery-orthophoto.png: colours of simulated streets.

python docs/imagery_pictures.py
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Final

import laspy
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import rasterio

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.painted_objects import photographed_street, scene
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate
from roadscan.survey.run import run_stages

PICTURES: Final = Path(__file__).resolve().parent / "pictures"
STAGES: Final = ("ingest", "navigate", "footprints", "tiles", "colours")
SIZE_PX: Final = (1100, 620)
FOCAL_PX: Final = 700.0


def main() -> None:
    """Run two short surveys, and draw a picture of each."""
    mpl.use("Agg")
    with tempfile.TemporaryDirectory() as folder:
        ahead = scene(24.0, camera={"colour": True, "every_m": 3.0}, vehicle={"standstill_s": 0.0})
        draw_points(made(ahead, Path(folder) / "ahead", "\n[colours]\n"))
        below = photographed_street(20.0, camera={"colour": True, "width_px": 1000, "height_px": 700})
        draw_photo(made(below, Path(folder) / "below", "\n[colours]\npoints = false\n[colours.orthophoto]\n"))


def made(one: Scene, folder: Path, sections: str) -> Session:
    """Simulate and run a survey."""
    file = simulate(one, folder).survey_file
    with file.open("a") as stream:
        stream.write(sections)
    session = Session.open(file)
    run_stages(session, [stage_named(name) for name in STAGES])
    return session


def draw_points(session: Session) -> None:
    """Write the picture of the cloud; points without a colour are light grey."""
    parts = [laspy.read(p) for p in sorted(Path(session.store.path("products/coloured_points")).glob("*.laz"))]
    place = np.concatenate([np.column_stack([p.x, p.y, p.z]) for p in parts])
    colour = np.concatenate([np.column_stack([p.red, p.green, p.blue]) // 257 for p in parts])
    has = np.concatenate([np.asarray(p["pictures"]) for p in parts]) > 0
    colour[~has] = 225
    plt.imsave(PICTURES / "imagery-points.png", seen(place, colour.astype(np.uint8), has))


def draw_photo(session: Session) -> None:
    """Write the picture of the orthophoto, beside the numbers of its pictures."""
    with rasterio.open(session.store.path("products/orthophoto/orthophoto.vrt")) as raster:
        rgb, number = np.moveaxis(raster.read([1, 2, 3]), 0, -1), raster.read(4)
    rows, columns = np.nonzero(number)
    cut = tuple(slice(max(m - 450, 0), m + 450) for m in (int(np.median(rows)), int(np.median(columns))))
    shown = np.concatenate([rgb[cut], plt.get_cmap("tab20", 20)(number[cut] % 20, bytes=True)[..., :3]], axis=1)
    shown[np.concatenate([number[cut]] * 2, axis=1) == 0] = 255
    plt.imsave(PICTURES / "imagery-orthophoto.png", shown)


def seen(place: np.ndarray, colour: np.ndarray, has: np.ndarray) -> np.ndarray:
    """A cloud from behind and above the street; the nearest point of each pixel is shown."""
    low, high = (np.percentile(place[has], q, axis=0) for q in (3, 97))
    middle = np.append((low[:2] + high[:2]) / 2, low[2])
    values, vectors = np.linalg.eigh(np.cov(place[has][:, :2].T))
    along = vectors[:, np.argmax(values)]
    along = along * np.sign(along[1])
    eye = middle + np.append(-18.0 * along, 8.0)
    ahead = (middle - eye) / np.linalg.norm(middle - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    x, y, z = ((place - eye) @ np.column_stack([right, np.cross(ahead, right), ahead])).T
    ahead_of = z > 1.0
    u, v = (FOCAL_PX * a[ahead_of] / z[ahead_of] + n / 2 for a, n in zip((x, y), SIZE_PX, strict=True))
    inside = (u >= 0) & (u < SIZE_PX[0] - 1) & (v >= 0) & (v < SIZE_PX[1] - 1)
    order = np.flatnonzero(inside)[np.argsort(-z[ahead_of][inside])]
    picture = np.full((SIZE_PX[1], SIZE_PX[0], 3), 255, np.uint8)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        picture[v[order].astype(int) + i, u[order].astype(int) + j] = colour[ahead_of][order]
    return picture


if __name__ == "__main__":
    main()
