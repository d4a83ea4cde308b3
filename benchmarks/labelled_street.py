"""A street whose returns were labelled by hand (SemanticKITTI), as a survey that a user would write, and its products.

The folder has the form of KITTI: ``sweeps.tar.xz`` (or ``velodyne_points/data`` and ``labels``) and ``poses.csv``. The
survey file states what the recording states and no setting of `[assets]`.
"""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import geopandas
import laspy
import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.spatial import cKDTree

from roadscan.core.survey import Survey
from roadscan.store.asset_schema import asset_tables
from roadscan.store.store import Store

Float64 = npt.NDArray[np.float64]

RECORDING: Final = "semantic_kitti_00"
_SAME_M: Final = 0.003
"""A point of a product is the return that lies so near (m): products round to 1 mm in each direction."""

_SURVEY: Final = """
id = "{name}"
rig = "rig.toml"
store = "store"
[map.local]
name = "Velodyne axes at sweep 0"
[tiles]
cell_m = {cell_m}
[adjust]
on = false
[[runs]]
id = "drive"
[[runs.logs]]
path = "poses.csv"
format = "pose_matrices"
crs = "local"
clock = {{ system = "unix_utc" }}
options = {{ axes = "flu" }}
[[runs.logs]]
path = "sweeps"
format = "kitti"
sensor = "velodyne"
clock = {{ system = "unix_utc" }}
options = {{ stamps = "../stamps.csv", stamp_column = "unix_utc_s", {turn} }}
"""
_PICTURES: Final = """[[runs.logs]]
path = "{folder}"
format = "images"
sensor = "camera"
clock = {{ system = "unix_utc", unit = "s" }}
options = {{ stamps = "../pictures.csv" }}
"""
_RIG: Final = """
name = "KITTI car (2011)"
[sensors.velodyne]
kind = "lidar"
axes = "flu"
range_min_m = 2.5
"""


@dataclass(frozen=True, eq=False)
class LabelledStreet:
    """Products of the survey beside the labels of its returns, in the frame of sweep 0 (x ahead, y left, z up, m)."""

    folder: Path
    places_m: Float64
    """(n, 3) all returns of the sweeps that were taken."""
    labels: npt.NDArray[np.uint8]
    """(n,)."""
    points_m: Float64
    """(k, 3) points of the classified clouds."""
    classes: npt.NDArray[np.uint8]
    """(k,) as the products have them."""
    point_labels: npt.NDArray[np.uint8]
    """(k,) label of the return that a point is; 0, not judged, where there is none."""
    tables: dict[str, geopandas.GeoDataFrame]
    """Objects by kind."""

    def objects(self, *kinds: str) -> pd.DataFrame:
        """Objects of some kinds, with their kind."""
        held = [self.tables[kind].assign(kind=kind) for kind in kinds if kind in self.tables]
        return pd.concat(held, ignore_index=True) if held else pd.DataFrame()


def survey_text(
    name: str = RECORDING, cell_m: float = 0.2, turn: str = 'turn = "compensated"', pictures: str = ""
) -> str:
    """Survey file of a KITTI car.

    turn : options that say how a sweep became a picture of one instant.
    pictures : folder of its pictures; "" without.
    """
    text = _SURVEY.format(name=name, cell_m=cell_m, turn=turn)
    return text + (_PICTURES.format(folder=pictures) if pictures else "")


def laid_out(recording: Path, folder: Path, sweeps: Iterable[int]) -> Path:
    """Write the survey of some sweeps of a recording below a folder; returns its survey file."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(recording / "poses.csv", folder / "poses.csv")
    wanted = {f"{number:010d}" for number in sweeps}
    _take_sweeps(recording, folder / "sweeps", wanted)
    rows = (folder / "poses.csv").read_text().splitlines()[1:]
    stamps = [row.split(",")[:2] for row in rows if f"{int(row.split(',')[0]):010d}" in wanted]
    with (folder / "stamps.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["frame", "unix_utc_s"], *stamps])
    (folder / "rig.toml").write_text(_RIG)
    (folder / "SURVEY.toml").write_text(f"{survey_text()}[assets]\n")
    return folder / "SURVEY.toml"


def _take_sweeps(recording: Path, folder: Path, wanted: set[str]) -> None:
    """Copy the sweeps that are wanted, and their labels."""
    packed = recording / "sweeps.tar.xz"
    if not packed.is_file():
        for name, end in (("velodyne_points/data", "bin"), ("labels", "label")):
            (folder / name).mkdir(parents=True, exist_ok=True)
            for stem in wanted:
                shutil.copyfile(recording / name / f"{stem}.{end}", folder / name / f"{stem}.{end}")
        return
    with tarfile.open(packed) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # from Python 3.11.4
        archive.extractall(folder, [one for one in archive.getmembers() if Path(one.name).stem in wanted])


def run(survey_file: Path, *more: str) -> None:
    """Call ``roadscan run`` on a survey file as a user does."""
    subprocess.run([sys.executable, "-m", "roadscan", "run", str(survey_file), *more], check=True)


def labelled_street(recording: Path, folder: Path, sweeps: Iterable[int]) -> LabelledStreet:
    """The products of some sweeps: the survey is written and run where that was not done before."""
    numbers = tuple(sweeps)
    file = folder / "SURVEY.toml"
    if not file.is_file():
        run(laid_out(recording, folder, numbers))
    return read_street(folder)


def read_street(folder: Path) -> LabelledStreet:
    """The products in a folder that was run, with the labels of its returns."""
    survey = Survey.load(folder / "SURVEY.toml")
    store = Store(survey.store_url, survey.config.id)
    places, labels = (np.concatenate(parts) for parts in zip(*labelled_sweeps(folder), strict=True))
    points, found = classified_points(store)
    away, nearest = cKDTree(places).query(points, distance_upper_bound=_SAME_M, workers=-1)
    own = np.where(np.isfinite(away), np.append(labels, np.uint8(0))[nearest], np.uint8(0)).astype(np.uint8)
    tables = {}
    for table, kind in asset_tables().items():
        file = Path(store.path(f"products/assets/{table}.parquet"))
        if file.is_file():
            tables[kind] = geopandas.read_parquet(file)
    return LabelledStreet(folder, places, labels, points, found, own, tables)


def classified_points(store: Store) -> tuple[Float64, npt.NDArray[np.uint8]]:
    """Points (n, 3) of the classified clouds of a store, and their classes (n,)."""
    read = [laspy.read(cloud) for cloud in sorted(Path(store.path("products/classified_points")).glob("*.laz"))]
    classes = np.concatenate([np.asarray(one.classification, np.uint8) for one in read])
    return np.concatenate([np.asarray(one.xyz) for one in read]), classes


def labelled_sweeps(folder: Path) -> Iterator[tuple[Float64, npt.NDArray[np.uint8]]]:
    """Returns (n, 3) of each sweep in a folder in the frame of sweep 0, and their labels (n,)."""
    table = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    poses = {int(row[0]): row[2:14].reshape(3, 4) for row in table}
    for file in sorted((folder / "sweeps" / "velodyne_points" / "data").glob("*.bin")):
        pose = poses[int(file.stem)]
        sweep = np.fromfile(file, "<f4").reshape(-1, 4).astype(np.float64)
        label = np.fromfile(folder / "sweeps" / "labels" / f"{file.stem}.label", np.uint8)
        yield sweep[:, :3] @ pose[:, :3].T + pose[:, 3], label


def recording_folder(name: str = RECORDING) -> Path:
    """Folder of a recording: that of the variable ``ROADSCAN_LABELLED_STREET``, else below ``ROADSCAN_DATA``."""
    own = os.environ.get("ROADSCAN_LABELLED_STREET")
    folder = Path(own) if own else Path(os.environ.get("ROADSCAN_DATA", "../shared/data")) / name
    if not folder.is_dir():
        raise FileNotFoundError(f"no recording at {folder}: set ROADSCAN_DATA to the folder of the recordings")
    return folder
