"""A disk that is full: every writer's failure says so, and the next run goes on where the one before it stopped."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
import shapely
from matplotlib.figure import Figure
from PIL import Image
from pyogrio.raw import write as write_vector

from roadscan.core.errors import FullDiskError, RoadscanError
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import write_parquet
from roadscan.survey.preflight import preflight
from roadscan.survey.run import run_stages
from roadscan.survey.status import verify_store
from tests.drawing import drawn
from tests.surveys import Simulated, changed, outputs

DISK_BYTES = 48 << 20
ROOM = r"the disk is full: [0-9.]+ MB are free of 50 MB .*see to more room, and run again: .*goes on where"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 50 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(folder)]
    if os.getuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a small file system can be mounted by root alone")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def leave(disk: Path, room_bytes: int) -> Path:
    """Fill the disk but for some bytes."""
    ballast = disk / "ballast"
    with ballast.open("wb") as stream:
        os.posix_fallocate(stream.fileno(), 0, shutil.disk_usage(disk).free - room_bytes)
    return ballast


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 1 << 16, shape).astype(np.uint16)


def write_geotiff(file: Path) -> None:
    with rasterio.open(file, "w", driver="GTiff", width=1000, height=1000, count=1, dtype="uint16") as raster:
        raster.write(noise(1000, 1000), 1)


def write_laz(file: Path) -> None:
    cloud = laspy.create(point_format=6, file_version="1.4")
    cloud.x, cloud.y, cloud.z = (noise(300_000).astype(float) for _ in range(3))
    cloud.write(file, do_compress=True)


def write_picture(file: Path) -> None:
    figure = Figure(figsize=(10, 10))
    figure.figimage(noise(1000, 1000))
    with drawn():
        figure.savefig(file)


def write_layer(file: Path) -> None:
    points = shapely.to_wkb(shapely.points(noise(30_000, 2).astype(float)))
    write_vector(file, points, [], fields=[], geometry_type="Point", crs="EPSG:25832", driver="GPKG")


def write_returns(file: Path) -> None:
    columns = {c.name: noise(300_000) for c in table_schema("returns").columns}
    write_parquet(file, pa.table(columns).cast(table_schema("returns").arrow()), table_schema("returns"))


def write_bytes(file: Path) -> None:
    file.write_bytes(bytes(2_000_000))


WRITERS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "GDAL": (".tif", write_geotiff),
    "laspy": (".laz", write_laz),
    "pyarrow": (".parquet", lambda file: pq.write_table(pa.table({"a": noise(1_000_000)}), file)),
    "pyogrio": (".gpkg", write_layer),
    "matplotlib": (".png", write_picture),
    "PIL": (".png", lambda file: Image.fromarray(noise(1000, 1000)).save(file)),
    "our own": (".parquet", write_returns),
    "bytes": (".bin", write_bytes),
}


@pytest.mark.slow
def test_every_writer_says_what_is_full(disk: Path) -> None:
    store = Store(str(disk / "store"), "s")
    store.write_bytes("manifest/first", b"1")
    leave(disk, 300_000)
    for name, (suffix, write) in WRITERS.items():
        with pytest.raises(FullDiskError, match=ROOM) as raised, store.scratch() as folder:
            write(folder / f"file{suffix}")
        assert raised.value.file == store.root, name
    with pytest.raises(FullDiskError, match=ROOM):
        store.write_bytes("manifest/second", bytes(1_000_000))
    assert store.files("manifest") == ["manifest/first"] and store.files(".staging") == []


@pytest.mark.slow
def test_a_run_on_a_full_disk_goes_on_when_there_is_room(finished: Simulated, disk: Path) -> None:
    products = {"products__make": ["las", "geotiff", "hillshade", "mosaic"]}
    survey = changed(Survey.load(finished.survey_file), products)
    store = Store(str(disk / "store"), survey.config.id)
    run_stages(Session(survey, store, Inline()), stages()[:3])
    ballast = leave(disk, 700_000)
    with pytest.raises(RoadscanError, match=ROOM) as raised:
        run_stages(Session(survey, store, Inline()), stages())
    assert store.root in str(raised.value) and str(raised.value).count(".staging") == 0
    ballast.unlink()
    done = Session(survey, store, Inline())
    run_stages(done, stages())
    assert verify_store(store) == []
    assert outputs(store) == outputs(finished.run(name="store-roomy", **products).store)


def test_logs_that_are_larger_than_the_room_are_told_before(
    simulated: Simulated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = simulated.copy_to(tmp_path / "survey")
    survey = Survey.load(copy.survey_file)
    said = "are free on the store's disk: the run may stop for want of room"
    assert not any(said in note for note in preflight(survey, copy.store()).notes)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=10**9, used=10**9 - 5000, free=5000))
    (note,) = [note for note in preflight(survey, copy.store()).notes if said in note]
    logs = sum((copy.survey_file.parent / log.path).stat().st_size for run in survey.config.runs for log in run.logs)
    assert logs / 1e6 == pytest.approx(float(note.partition(" MB")[0].rpartition(" ")[2]), abs=0.2)
    assert "5.0 kB are free" in note
