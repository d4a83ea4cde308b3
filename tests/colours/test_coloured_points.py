"""Coloured clouds of a street in whose pictures each object has a colour of its own, and the orthophoto of its road."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
import rasterio

from benchmarks.painted_objects import code_of, judged, nearest_code, scene, seen_by_truth, written
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Compute, Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import truth
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.surface.test_surfaces import TwoThreads
from tests.surveys import Lines, changed, outputs

STAGES = tuple(stage_named(name) for name in ("ingest", "navigate", "footprints", "tiles"))
COLOURS = (stage_named("colours"),)
SECTIONS = "\n[colours]\n[colours.orthophoto]\ncell_m = 0.02\n"


class Street:
    """A short labelled street, ingested and tiled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        small = scene(
            10.0, camera={"every_m": 2.0, "width_px": 320, "height_px": 200, "focal_px": 270.0},
            vehicle={"standstill_s": 0.0}, lidar={"range_max_m": 15.0}, roadside={"trees": []},
        )  # fmt: skip
        self.survey = Survey.load(written(folder, SECTIONS, small))
        self.run(self.survey, stages=STAGES)

    def run(self, survey: Survey, compute: Compute | None = None, stages: tuple = COLOURS) -> Session:
        session = Session(survey, Store(survey.store_url, survey.config.id), compute or Inline(), None, Lines())
        run_stages(session, stages)
        return session

    def products(self, session: Session) -> dict[str, bytes]:
        held = outputs(session.store)
        return {p: c for p, c in held.items() if "coloured_points" in p or "orthophoto" in p}


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    return Street(tmp_path_factory.mktemp("colours") / "survey")


@pytest.fixture(scope="module")
def coloured(street: Street) -> Session:
    return street.run(street.survey)


@pytest.mark.slow
def test_points_have_the_colours_of_what_they_lie_on(street: Street, coloured: Session) -> None:
    assert not coloured.failures
    found = judged(street.folder, Path(coloured.store.path("products/coloured_points")))
    assert found.coloured.sum() > 100_000
    assert found.wrong.sum() <= 0.002 * found.coloured.sum()  # a pixel is 4 mrad here
    known = truth.load(street.folder)
    _, offset = known.station_offset_m(*found.place_m[:, :2].T)
    lane = (found.object_id == 0) & (np.abs(offset) < 2.5) & seen_by_truth(street.folder, found, farthest_m=15.0)
    assert lane.sum() > 10_000
    assert np.mean(found.pictures[lane] > 0) >= 0.98  # the rest lies beside the car ahead, within a coarse pixel or two


@pytest.mark.slow
def test_files_say_what_has_no_colour(coloured: Session) -> None:
    files = sorted(Path(coloured.store.path("products/coloured_points")).glob("*.laz"))
    points = unseen = 0
    for file in files:
        read = laspy.read(file)
        assert read.header.point_format.id == 7
        none = np.asarray(read["pictures"]) == 0
        colour = np.column_stack([read.red, read.green, read.blue])
        assert (colour[none] == 0).all()
        assert (colour[~none].max(axis=1) > 0).all()
        (facts,) = (json.loads(v.record_data) for v in read.header.vlrs if v.user_id == "roadscan")
        assert (facts["points"], facts["coloured"]) == (len(none), int((~none).sum()))
        points, unseen = points + len(none), unseen + int(none.sum())
    lines = coloured.reporter.lines  # type: ignore[attr-defined]
    assert f"note: colours: {unseen:,} of {points:,} points are in no picture, and have no colour" in lines
    assert 0 < unseen < points


@pytest.mark.slow
def test_orthophoto_is_one_raster_with_the_pictures_it_came_from(street: Street, coloured: Session) -> None:
    folder = Path(coloured.store.path("products/orthophoto"))
    with rasterio.open(folder / "orthophoto.vrt") as whole:
        assert whole.descriptions == ("red", "green", "blue", "picture")
        assert whole.nodata == 0
        assert whole.res == (0.02, 0.02)
        total = int((whole.read(4) > 0).sum())
    pixels = 0
    names = {p.name for p in (street.folder / "raw/run-1/camera").glob("*.jpg")}
    for file in folder.glob("*.tif"):
        with rasterio.open(file) as one:
            colour, number = np.moveaxis(one.read([1, 2, 3]), 0, -1), one.read(4)
        rows = list(csv.DictReader(file.with_suffix(".csv").read_text().splitlines()))
        assert {int(r["picture"]) for r in rows} == set(np.unique(number[number > 0]).tolist())
        assert {r["file"] for r in rows} <= names
        assert all(int(r["pixels"]) == int((number == int(r["picture"])).sum()) for r in rows)
        assert ((colour.max(axis=-1) > 0) == (number > 0)).all()
        pixels += int((number > 0).sum())
    assert pixels == total > 0
    known = truth.load(street.folder)
    with rasterio.open(folder / "orthophoto.vrt") as whole:
        rows, columns = np.nonzero(whole.read(4))
        values, place = np.moveaxis(whole.read([1, 2, 3]), 0, -1)[rows, columns], whole.transform
    _, offset = known.station_offset_m(place.c + place.a * (columns + 0.5), place.f + place.e * (rows + 0.5))
    lane = np.abs(offset) < 2.5  # cars stand and drive elsewhere, or are left out by their depth
    road = nearest_code(values[lane]) == code_of(np.array([0]))[0]
    assert lane.sum() > 20_000
    assert road.mean() > 0.999


@pytest.mark.slow
def test_blocks_and_workers_change_no_byte(street: Street, coloured: Session) -> None:
    first = street.products(coloured)
    assert first
    coloured.manifest.remove(coloured.manifest.beside({"coloured_points", "orthophoto", "picture_depths"}, ()))
    single = changed(street.survey, {"colours__max_block_readings": 1, "tiles__block_tiles": 1})
    assert street.products(street.run(single, TwoThreads())) == first


@pytest.mark.slow
def test_a_second_run_does_nothing_and_blank_pictures_cost_themselves(street: Street, coloured: Session) -> None:
    again = street.run(street.survey)
    state = COLOURS[0].state(again)
    assert (state.stale, state.current > 0) == (0, True)
    camera = street.folder / "raw/run-1/camera"
    third = sorted(camera.glob("*.jpg"))[2]
    content = bytearray(third.read_bytes())
    content[len(content) // 2] ^= 8  # whole to look at, and cannot be decoded
    third.write_bytes(content)
    second, fourth = (sorted(camera.glob("*.jpg"))[k] for k in (1, 3))
    for file, value in ((second, 0), (fourth, 255)):
        cv2.imwrite(str(file), np.full((200, 320, 3), value, np.uint8))
    run = street.run(street.survey, stages=(*STAGES, *COLOURS))
    assert not run.failures
    told = [n for n in run.reporter.lines if "give no colour" in n]  # type: ignore[attr-defined]
    assert len(told) == 1
    assert "3 pictures give no colour: " in told[0] and f"run-1/camera/{third.name}: " in told[0]
    assert f"run-1/camera/{second.name}: it is black" in told[0]
    assert f"run-1/camera/{fourth.name}: it is overexposed" in told[0]
    found = judged(street.folder, Path(run.store.path("products/coloured_points")))
    assert 0 < found.wrong.sum() <= 0.01 * found.coloured.sum()


@pytest.mark.slow
def test_without_the_section_nothing_is_made(street: Street) -> None:
    none = changed(street.survey, {"colours": None})
    session = street.run(none)
    assert not street.products(session)
    assert not session.manifest.of("picture_depths")
    assert COLOURS[0].state(session).current == 0
