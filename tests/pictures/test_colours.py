"""Colours of cameras on the mesh: a road painted like a chessboard, in pictures that this file makes itself."""

from __future__ import annotations

import json
import shutil
import tempfile
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pyarrow.parquet as pq
import pyproj
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from roadscan.core.errors import ConfigError
from roadscan.core.survey import Survey
from roadscan.pictures.placed import Pictures
from roadscan.run.engine.compute import Compute, Inline
from roadscan.run.session import Session
from roadscan.run.stage import Stage, stages
from roadscan.simulate import simulate, truth
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.surface.stage import plan_surface_work
from roadscan.surface.tasks.surface_plan import SURFACE
from roadscan.survey.run import run_stages
from tests.surface.test_surfaces import SURFACES, TwoThreads
from tests.surveys import Lines, Simulated, changed, outputs, small_scene

WIDTH, HEIGHT, FOCAL = 240, 160, 200.0
DISTORTION = (-0.12, 0.03, 0.002, -0.003, 0.0)
INTERIOR = {
    "width_px": WIDTH, "height_px": HEIGHT, "focal_px": (FOCAL, FOCAL), "distortion": DISTORTION,
    "principal_px": ((WIDTH - 1) / 2, (HEIGHT - 1) / 2),
}  # fmt: skip
SQUARE_M = 0.8
CAMERA = "rig__sensors__camera"
INGEST = tuple(s for s in stages() if s.name == "ingest")
COLOURED: dict[str, object] = {"colours": "camera", "spacing_m": 0.05, "format": "ply", "camera_reach_m": 6.0}


def painted(easting_m: np.ndarray, northing_m: np.ndarray) -> np.ndarray:
    """Colour (…, 3: red, green, blue) of the road: red tells the column of a square, green its row."""
    i, j = (np.floor(a / SQUARE_M).astype(int) for a in (easting_m, northing_m))
    return np.stack([40 + i * 37 % 5 * 40, 40 + j * 53 % 5 * 40, 30 + (i + j) % 2 * 190], axis=-1).astype(np.uint8)


def pictured(known: truth.Truth, pose: dict[str, float], to_map: pyproj.Transformer) -> np.ndarray:
    """What a camera of that interior orientation sees of it: a ray through each pixel to the true surface."""
    v, u = np.indices((HEIGHT, WIDTH), dtype=float)
    matrix = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    pixel = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    flat = cv2.undistortPoints(pixel, matrix, np.array(DISTORTION), criteria=(3, 50, 1e-12)).reshape(-1, 2)
    rotation = Rotation.from_quat([pose[q] for q in ("qx", "qy", "qz", "qw")]).as_matrix()
    ray = np.column_stack([np.ones(len(flat)), flat]) @ rotation.T
    eye = np.array([pose[f"{a}_world_m"] for a in "xyz"])
    begin, end = (np.stack(to_map.transform(*(eye + s * ray).T), axis=-1) for s in (0.0, 10.0))
    way = (end - begin) / 10.0  # the map is straight to 0.1 mm so near
    down = np.flatnonzero(way[:, 2] < -0.28)
    begin, way = begin[down], way[down]
    far = np.full(down.size, 2.0)
    for _ in range(3):
        height = known.height_m(*(begin + far[:, None] * way)[:, :2].T)
        far = np.where(np.isnan(height), far, (height - begin[:, 2]) / way[:, 2])
    colour = np.full((WIDTH * HEIGHT, 3), 255, np.uint8)
    colour[down] = painted(*(begin + far[:, None] * way)[:, :2].T)
    return colour.reshape(HEIGHT, WIDTH, 3)


class Drive:
    """A finished survey with such pictures."""

    def __init__(self, simulated: Simulated, store: Store) -> None:
        self.simulated, self.store = simulated, store
        self.folder = simulated.survey_file.parent
        self.pictures = self.folder / "raw" / "run-1" / "camera"
        self.lines: list[str] = []

    def survey(self, options: dict[str, object] = COLOURED, **changes: object) -> Survey:
        surface = {"method": "cells", "sigma_m": 0.002}
        products = {"make": ["surface_mesh"], "options": {"surface_mesh": options}}
        settings = {f"{CAMERA}__interior": dict(INTERIOR), "surface": surface, "products": products} | changes
        return changed(Survey.load(self.simulated.survey_file), settings)

    def run(
        self, survey: Survey, compute: Compute | None = None, stages: tuple[Stage, ...] = SURFACES
    ) -> dict[str, bytes]:
        manifest = Manifest(self.store)
        manifest.forget(SURFACE, list(manifest.of(SURFACE)))
        run = Session(survey, self.store, compute or Inline(), None, Lines())
        run_stages(run, stages)
        self.lines = run.reporter.lines  # type: ignore[attr-defined]
        return {p: data for p, data in outputs(self.store).items() if p.startswith("tiles/surface")}

    @cached_property
    def usual(self) -> tuple[dict[str, bytes], dict[str, int], list[str]]:
        """Files, figures and what was said, with the settings as they are above."""
        files = self.run(self.survey())
        return files, self.figures(), self.lines

    def figures(self) -> dict[str, int]:
        found = [r.figures() for r in Manifest(self.store).of(SURFACE).values()]
        own = [f["colours:surface_mesh"] for f in found if "colours:surface_mesh" in f]
        return {k: sum(f[k] for f in own) for k in ("vertices", "unseen", "pictures")}


def vertices(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Place (n, 3) on the map and colour (n, 3) of a tile's PLY."""
    with tempfile.NamedTemporaryFile() as file:  # of a file it reads triangles at once, else one by one
        file.write(content)
        file.flush()
        ply = plyfile.PlyData.read(file.name, known_list_len={"face": {"vertex_indices": 3}})
    origin = json.loads(dict(c.split(" ", 1) for c in ply.comments)["origin_m"])
    vertex = ply["vertex"]
    place = np.stack([vertex[a].astype(float) + o for a, o in zip("xyz", origin, strict=True)], axis=-1)
    return place, np.stack([vertex[c] for c in ("red", "green", "blue")], axis=-1)


def right_share(files: dict[str, bytes], blur_m: float = 0.05) -> tuple[float, float]:
    """Share of the vertices with a colour that is no grey, and of these the share that has the road's, to the bit."""
    place, colour = (np.concatenate(a) for a in zip(*map(vertices, files.values()), strict=True))
    inside = (np.abs(place[:, :2] / SQUARE_M % 1.0 - 0.5) < 0.5 - blur_m / SQUARE_M).all(axis=1)
    place, colour = place[inside], colour[inside]
    seen = np.ptp(colour.astype(int), axis=1) > 0
    right = (colour == painted(*place[:, :2].T)).all(axis=1)[seen]
    return float(seen.mean()), float(right.mean()) if right.size else 0.0


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    scene = small_scene(
        length_m=14.0, passes=[{"lane": 2}], lidar={"on": False}, noise={"position_m": 0.0, "attitude_deg": 0.0},
        camera={
            "on": True, "every_m": 1.5, "width_px": 64, "height_px": 64,
            "mount": {"pitch_deg": -28.0, "heading_deg": 7.0},
        },
    )  # fmt: skip
    simulated = Simulated(simulate(scene, tmp_path_factory.mktemp("coloured") / "survey").survey_file)
    folder = simulated.survey_file.parent / "raw" / "run-1" / "camera"
    known = truth.load(simulated.survey_file.parent)
    to_map = pyproj.Transformer.from_crs("EPSG:4978", pyproj.CRS(scene.map.crs).to_3d(), always_xy=True)
    for pose in pq.read_table(known.camera_file("run-1")).to_pylist():
        (folder / pose["file"]).unlink()
        name = str(Path(pose["file"]).with_suffix(".png"))
        assert cv2.imwrite(str(folder / name), pictured(known, pose, to_map)[:, :, ::-1])
    stamps = folder / "stamps.csv"
    stamps.write_text(stamps.read_text().replace(".jpg", ".png"))
    simulated.run(products={"make": [], "options": {}})
    return Drive(simulated, simulated.store())


@pytest.mark.slow
def test_vertices_have_the_colour_of_the_ground(drive: Drive) -> None:
    files, told, lines = drive.usual
    seen, right = right_share(files)
    assert seen > 0.4 and right == 1.0
    assert 0 < told["unseen"] < 0.6 * told["vertices"] and told["pictures"] >= len(files)
    assert [n for n in lines if "in no picture" in n] == [
        f"note: surface_mesh: {told['unseen']:,} of {told['vertices']:,} vertices are in no picture, and stay grey"
    ]
    grey = drive.run(drive.survey(COLOURED | {"colours": "intensity"}))
    unseen = 0
    for path in files:
        (place, colour), (same, plain) = vertices(files[path]), vertices(grey[path])
        assert np.array_equal(place, same) and (np.ptp(plain.astype(int), axis=1) == 0).all()
        blank = np.ptp(colour.astype(int), axis=1) == 0
        assert np.array_equal(colour[blank], plain[blank])
        unseen += int(blank.sum())
    assert grey.keys() == files.keys() and 0.9 * told["unseen"] <= unseen <= told["unseen"]  # some have no triangle


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [
    {f"{CAMERA}__boresight__heading_deg": -7.0, f"{CAMERA}__lever_arm_body_m": (0.9, 0.25, -1.15)},
    {f"{CAMERA}__boresight__pitch_deg": -27.0}, {f"{CAMERA}__axes": "rfu"},
])  # fmt: skip
def test_a_wrong_sign_shows(drive: Drive, wrong: dict[str, object]) -> None:
    assert right_share(drive.run(drive.survey(**wrong)))[1] < 0.95


@pytest.mark.slow
def test_neighbours_agree_and_workers_change_no_byte(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    files = drive.usual[0]
    place, colour = (np.concatenate(a) for a in zip(*map(vertices, files.values()), strict=True))
    _, which, count = np.unique(np.rint(place[:, :2] * 1e3), axis=0, return_inverse=True, return_counts=True)
    coloured = np.ptp(colour.astype(int), axis=1) > 0
    assert np.count_nonzero(count[which][coloured] > 1) > 100
    first = np.empty((count.size, 3), np.uint8)
    first[which] = colour  # any of those at one place
    assert np.array_equal(first[which], colour)
    monkeypatch.setattr("roadscan.surface.tasks.surface_plan._BLOCK_TILES", 1)
    monkeypatch.setattr("roadscan.pictures.colours._KEPT_BYTES", 0)
    monkeypatch.setattr("roadscan.pictures.colours._POINTS_AT_ONCE", 777)
    assert drive.run(drive.survey(), TwoThreads()) == files
    monkeypatch.setattr(Pictures, "near", lambda self, *_: self)  # all pictures: none that counts was left out
    assert drive.run(drive.survey()) == files


@pytest.mark.slow
def test_glb_has_the_same_colours_linear(drive: Drive) -> None:
    plain = drive.usual[0]
    bright = drive.run(drive.survey(COLOURED | {"format": "glb"}))
    for path, content in plain.items():
        _, colour = vertices(content)
        (mesh,) = trimesh.load(drive.store.path(path.replace(".ply", ".glb"))).geometry.values()
        assert b'"KHR_materials_unlit"' in bright[path.replace(".ply", ".glb")]
        linear = mesh.visual.vertex_attributes["color"]
        assert linear.dtype == np.uint16 and (linear[:, 3] == 65_535).all()
        encoded = linear[:, :3] / 65_535.0
        encoded = np.where(encoded <= 0.0031308, 12.92 * encoded, 1.055 * encoded ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
        assert np.array_equal(np.rint(255.0 * encoded), colour)
    assert len(bright) == len(plain)


@pytest.mark.slow
def test_damaged_pictures_cost_themselves(drive: Drive, tmp_path: Path) -> None:
    whole, before, _ = drive.usual
    names = sorted(p.name for p in drive.pictures.glob("*.png"))
    shutil.copytree(drive.pictures, tmp_path / "kept")
    try:
        cut, torn = (drive.pictures / n for n in names[3:5])
        cut.write_bytes(cut.read_bytes()[:900])  # ingest tells that it is not whole
        content = bytearray(torn.read_bytes())
        content[len(content) // 2] ^= 8  # whole to look at, and cannot be decoded
        torn.write_bytes(content)
        drive.run(drive.survey(), TwoThreads(), INGEST)
        files = drive.run(drive.survey(), TwoThreads())
    finally:
        shutil.copytree(tmp_path / "kept", drive.pictures, dirs_exist_ok=True)
    told = [n for n in drive.lines if "cannot be read" in n]
    assert len(told) == 1 and told[0].count(f"1 pictures cannot be read: run-1/camera/{torn.name}: ") == 1
    assert before["unseen"] < drive.figures()["unseen"] < before["vertices"]
    assert right_share(files, 0.25)[1] > 0.98  # what the next best pictures say, from farther away
    assert files.keys() == whole.keys() and files != whole
    drive.run(drive.survey(), stages=INGEST)


@pytest.mark.slow
def test_the_own_vehicle_colours_nothing(drive: Drive) -> None:
    lower = ((0.0, 100.0), (WIDTH, 100.0), (WIDTH, HEIGHT), (0.0, HEIGHT))
    files = drive.run(drive.survey(**{f"{CAMERA}__own_vehicle_px": [lower]}))
    assert drive.figures()["unseen"] > drive.usual[1]["unseen"]
    assert right_share(files, 0.25)[1] > 0.98


@pytest.mark.slow
def test_tiles_that_a_picture_may_show_depend_on_it(drive: Drive) -> None:
    def keys(options: dict[str, object] = COLOURED, **changes: object) -> dict[str, str]:
        planned = plan_surface_work(Session(drive.survey(options, **changes), drive.store)).planned
        assert planned is not None
        return {str(t): key for t, key in planned.keys.items()}

    usual, grey = keys(), keys({"colours": "intensity"})
    assert keys() == usual and all(usual[t] != grey[t] for t in usual)
    for change in (
        {f"{CAMERA}__interior__focal_px": (201.0, 200.0)}, {f"{CAMERA}__lever_arm_body_m": (0.9, -0.25, -1.2)},
        {f"{CAMERA}__own_vehicle_px": [((0.0, 0.0), (9.0, 0.0), (0.0, 9.0))]},
    ):  # fmt: skip
        assert all(usual[t] != key for t, key in keys(**change).items())


@pytest.mark.slow
@pytest.mark.parametrize(("options", "changes", "message"), [
    ({}, {"rig__sensors__camera__kind": "lidar"}, "the rig has no camera"),
    ({}, {"rig__sensors__camera__interior": None}, "no interior orientation"),
    ({"cameras": ["front"]}, {}, "no camera 'front'"),
    ({}, {f"{CAMERA}__interior__width_px": 480}, "240 × 160 pixels"),
])  # fmt: skip
def test_what_cannot_be_coloured(
    drive: Drive, options: dict[str, object], changes: dict[str, object], message: str
) -> None:
    survey = drive.survey(COLOURED | options, **changes)
    stage = "tiles" if "pixels" in message else "ingest"
    with pytest.raises(ConfigError, match=message):
        run_stages(Session(survey, drive.store, Inline(), None, Lines()), [s for s in stages() if s.name == stage])


@pytest.mark.slow
def test_pictures_that_are_gone(drive: Drive) -> None:
    aside = drive.pictures.with_name("aside")
    drive.pictures.rename(aside)
    try:
        with pytest.raises(ConfigError, match="not where the survey file says"):
            drive.run(drive.survey())
    finally:
        aside.rename(drive.pictures)
