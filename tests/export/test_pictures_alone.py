"""A survey of poses and pictures without a scanner: its layer, its exports, and tracks of tie points in them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import geopandas
import numpy as np
import pandas as pd
import pytest
from PIL import Image
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import roadscan as rs
from benchmarks.picture_drive import laid_out
from roadscan.cli import app

FEW = range(14, 21)
ABOVE_M = 1.65
"""Height of the recording's camera above the road (m)."""


def told(*words: str) -> str:
    found = CliRunner().invoke(app, list(words))
    assert found.exit_code == 0, found.output
    return found.output


def on_earth(file: Path) -> None:
    """Lay the recording's local frame at a place of the Earth: x east, y north, z up."""
    poses = np.loadtxt(file.parent / "poses.txt").reshape(-1, 3, 4)
    lon, lat = np.radians([9.0, 48.0])
    east = [-np.sin(lon), np.cos(lon), 0.0]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    turn = np.column_stack([east, np.cross(up, east), up])
    origin = np.array(Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(9.0, 48.0, 500.0))
    world = np.concatenate([turn @ poses[:, :, :3], (poses[:, :, 3] @ turn.T + origin)[:, :, None]], axis=2)
    np.savetxt(file.parent / "poses.txt", world.reshape(-1, 12), fmt="%.9f")
    text = file.read_text().replace('[map.local]\nname = "axes of the vehicle at the first picture"',
                                    '[map]\ncrs = "EPSG:32632"\nheight = "ellipsoidal"')  # fmt: skip
    text = text.replace('crs = "local"', 'crs = "EPSG:4978"')
    file.write_text(text)


@pytest.fixture(scope="module")
def alone(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven pictures of a drive, their poses disturbed; the rig file states how high the camera is."""
    file = laid_out(recordings / "pictures" / "drive_left", tmp_path_factory.mktemp("alone"), (0.05, 0.1), 3, FEW)
    on_earth(file)
    rig = file.parent / "rig.toml"
    rig.write_text(rig.read_text().replace('axes = "frd"', f'axes = "frd"\nabove_road_m = {ABOVE_M}'))
    told("run", str(file))
    return file


@pytest.fixture(scope="module")
def residuals(alone: Path) -> pd.DataFrame:
    """Measurements of tie points that count, as the adjustment left them."""
    rows = pd.DataFrame(rs.open_survey(alone).table("picture_residuals"))
    rows = rows[rows["track"].notna() & (rows["weight"] > 0.0)]
    assert len(rows) > 300 and (rows["weight"] < 1.0).any()
    return rows[["file", "u_px", "v_px", "after_u_px", "after_v_px", "track"]]


def layer(file: Path) -> geopandas.GeoDataFrame:
    (parquet,) = (file.parent / "store").glob("survey=*/products/pictures/*.parquet")
    return geopandas.read_parquet(parquet)


@pytest.mark.slow
def test_footprints_lie_on_a_plane_where_the_rig_states_its_height(alone: Path, tmp_path: Path) -> None:
    rows = layer(alone)
    assert len(rows) == len(FEW) and rows["without_pose"].isna().all() and rows["without_footprint"].isna().all()
    for row in rows.itertuples():
        heights = np.array(row.footprint.exterior.coords)[:, 2]
        assert np.allclose(heights, row.height_m - ABOVE_M, atol=1e-9) and row.footprint_on_ground == 0.0
        assert row.footprint_m2 == pytest.approx(row.footprint.area) and row.footprint_m2 > 100.0
    copy = tmp_path / "unstated"
    shutil.copytree(alone.parent, copy, ignore=shutil.ignore_patterns("store"))
    rig = copy / "rig.toml"
    rig.write_text(rig.read_text().replace(f"above_road_m = {ABOVE_M}\n", ""))
    (copy / "SURVEY.toml").write_text((copy / "SURVEY.toml").read_text().replace("[picture_ties]\n", ""))
    output = told("run", str(copy / "SURVEY.toml"))
    without = layer(copy / "SURVEY.toml")
    assert without["footprint"].isna().all() and without["easting_m"].notna().all()
    assert without["without_footprint"].str.contains("rig file states no above_road_m").all()
    words = " ".join(output.split())
    assert f"{len(FEW)} without a footprint: no ground is surveyed below the camera" in words
    told("export", "colmap", str(copy / "SURVEY.toml"), "--out", str(tmp_path / "bare"))
    points = (tmp_path / "bare/points3D.txt").read_text().splitlines()
    assert all(line.startswith("#") for line in points)  # nothing asks for tie points


def colmap_residuals(folder: Path) -> Iterator[tuple[str, float, float, float, float]]:
    """File, pixel and measured minus projected of each entry of POINTS2D, by colmap.github.io/format.html."""
    cameras, images, points = (
        [line.split() for line in (folder / name).read_text().splitlines() if not line.startswith("#")]
        for name in ("cameras.txt", "images.txt", "points3D.txt")
    )
    lens = {row[0]: [float(v) for v in row[4:]] for row in cameras}
    place = {row[0]: np.array([float(v) for v in row[1:4]]) for row in points}
    tracks = {row[0]: set(zip(row[8::2], row[9::2], strict=True)) for row in points}
    error = {row[0]: float(row[7]) for row in points}
    met: dict[str, list[float]] = {name: [] for name in place}
    for row, seen in zip(images[::2], images[1::2], strict=True):
        w, x, y, z = (float(v) for v in row[1:5])
        fx, fy, cx, cy, k1, k2, p1, p2 = lens[row[8]]
        for index, (u, v, name) in enumerate(zip(seen[::3], seen[1::3], seen[2::3], strict=True)):
            assert (row[0], str(index)) in tracks[name]
            tracks[name].discard((row[0], str(index)))
            own = Rotation.from_quat([x, y, z, w]).apply(place[name]) + [float(t) for t in row[5:8]]
            a, b = own[0] / own[2], own[1] / own[2]
            r2 = a * a + b * b
            radial = 1.0 + k1 * r2 + k2 * r2 * r2
            across = fx * (a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)) + cx
            down = fy * (b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)) + cy
            met[name].append(float(np.hypot(float(u) - across, float(v) - down)))
            yield row[9].rsplit("/", 1)[-1], float(u) - 0.5, float(v) - 0.5, float(u) - across, float(v) - down
    assert not any(tracks.values())
    for name, found in met.items():
        assert len(found) > 1 and error[name] == pytest.approx(np.mean(found), abs=0.02)


def opensfm_residuals(folder: Path) -> Iterator[tuple[str, float, float, float, float]]:
    """The same of `tracks.csv`, whose second version has picture, track, feature, x, y, scale, colour and two codes."""
    (whole,) = json.loads((folder / "reconstruction.json").read_text())
    header, *lines = (folder / "tracks.csv").read_text().splitlines()
    assert header == "OPENSFM_TRACKS_VERSION_v2"
    for line in lines:
        shot_name, track, _, x, y, _, *colour = line.split("\t")
        assert len(colour) == 5
        shot = whole["shots"][shot_name]
        camera = whole["cameras"][shot["camera"]]
        own = Rotation.from_rotvec(shot["rotation"]).apply(whole["points"][track]["coordinates"]) + shot["translation"]
        a, b = own[0] / own[2], own[1] / own[2]
        r2 = a * a + b * b
        radial = 1.0 + r2 * (camera["k1"] + r2 * (camera["k2"] + r2 * camera["k3"]))
        across = a * radial + 2.0 * camera["p1"] * a * b + camera["p2"] * (r2 + 2.0 * a * a)
        down = b * radial + 2.0 * camera["p2"] * a * b + camera["p1"] * (r2 + 2.0 * b * b)
        width, height = camera["width"], camera["height"]
        size = max(width, height)
        left = [
            float(x) - camera["focal_x"] * across - camera["c_x"],
            float(y) - camera["focal_y"] * down - camera["c_y"],
        ]
        u, v = float(x) * size + width / 2.0 - 0.5, float(y) * size + height / 2.0 - 0.5
        yield shot_name.rsplit("/", 1)[-1], u, v, left[0] * size, left[1] * size


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "read"), [("colmap", colmap_residuals), ("opensfm", opensfm_residuals)])
def test_tracks_are_those_that_the_adjustment_kept(
    alone: Path, residuals: pd.DataFrame, tmp_path: Path, kind: str, read
) -> None:
    told("export", kind, str(alone), "--out", str(tmp_path / "out"))
    rows = pd.DataFrame(list(read(tmp_path / "out")), columns=["file", "u_px", "v_px", "du", "dv"])
    rows["file"] = rows["file"].str.replace(".jpg", ".png")  # copies are JPEG files
    for frame in (rows, residuals):
        frame[["u", "v"]] = frame[["u_px", "v_px"]].round(3)
    both = rows.merge(residuals, on=["file", "u", "v"])
    pairs = residuals.groupby("track")["file"].transform("size") > 1
    assert len(both) == len(rows) == pairs.sum()
    off = both[["du", "dv"]].to_numpy() - both[["after_u_px", "after_v_px"]].to_numpy()
    assert np.abs(off).max() < 0.02
    assert both[["du", "dv"]].abs().to_numpy().max() > 0.3  # there is something to be equal to


@pytest.mark.slow
def test_some_pictures_have_the_tracks_that_they_share(alone: Path, tmp_path: Path) -> None:
    output = told("export", "colmap", str(alone), "--out", str(tmp_path / "out"), "--camera", "left")
    assert "copies them so" in output
    names = [line.split()[9] for line in (tmp_path / "out/images.txt").read_text().splitlines() if "drive/left" in line]
    told("export", "pictures", str(alone), "--out", str(tmp_path / "copies"))
    assert all((tmp_path / "copies" / name).is_file() for name in names) and len(names) == len(FEW)


@pytest.mark.slow
def test_names_of_two_logs_do_not_overwrite_one_another(alone: Path, tmp_path: Path) -> None:
    """The first two pictures become a log of their own, which calls one of them as another of the first log."""
    copy = tmp_path / "two"
    shutil.copytree(alone.parent, copy, ignore=shutil.ignore_patterns("store"))
    stamps = (copy / "pictures/stamps.csv").read_text().splitlines()
    (copy / "more").mkdir()
    first, second, third = (line.split(",") for line in stamps[1:4])
    shutil.move(copy / "pictures" / first[0], copy / "more" / third[0])
    shutil.move(copy / "pictures" / second[0], copy / "more" / "alone.png")
    (copy / "more/stamps.csv").write_text(f"file,time\n{third[0]},{first[1]}\nalone.png,{second[1]}\n")
    (copy / "pictures/stamps.csv").write_text("\n".join([stamps[0], *stamps[3:]]) + "\n")
    file = copy / "SURVEY.toml"
    text = file.read_text().replace("[picture_ties]\n", "")
    log = text[text.rindex("[[runs.logs]]") :]
    file.write_text(text + log.replace('"pictures"', '"more"'))
    told("run", str(file))
    told("export", "pictures", str(file), "--out", str(tmp_path / "out"))
    rows = pd.read_csv(tmp_path / "out/pictures.csv")
    assert len(rows) == len(FEW) == rows["file"].nunique()
    plain = {line.split(",")[0].replace(".png", ".jpg") for line in stamps[4:]} | {"alone.jpg"}
    assert {f"drive/left/{name}" for name in plain} < set(rows["file"])  # as without a clash
    clashing = sorted(set(rows["file"]) - {f"drive/left/{name}" for name in plain})
    assert [name.split("/")[2].rsplit("-", 1)[0] for name in clashing] == ["more", "pictures"]
    for name, original in zip(clashing, ("more", "pictures"), strict=True):
        with Image.open(tmp_path / "out" / name) as one, Image.open(copy / original / third[0]) as other:
            assert np.abs(np.asarray(one.convert("L"), int) - np.asarray(other.convert("L"), int)).mean() < 3.0
    told("export", "colmap", str(file), "--out", str(tmp_path / "sparse"))
    listed = [line.split()[9] for line in (tmp_path / "sparse/images.txt").read_text().splitlines() if "left/" in line]
    assert sorted(listed) == sorted(rows["file"])
