"""A store with damaged files: every command says what is wrong and what to do, and a run makes it whole again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import RoadscanError, RunError
from roadscan.core.grid import TileId
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Selection, Session
from roadscan.run.stage import stages
from roadscan.store.logs import copy_path, read_log_records, record_path
from roadscan.store.manifest import Manifest
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.survey.status import survey_status, verify_store
from tests.drawing import drawn
from tests.surveys import Simulated, changed, outputs

MAKE = {"products__make": ["las", "geotiff", "mosaic", "kilometre", "tile_table"]}
KINDS = ["tiles/cells", "tiles/overviews", "tiles/geotiff", "tiles/las", "tables/footprints", "products/tile_table"]


def flipped(content: bytes, other: bytes) -> bytes:
    place = len(content) // 3
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


DAMAGES: dict[str, Callable[[bytes, bytes], bytes] | None] = {
    "cut": lambda content, other: content[: len(content) // 2],
    "flipped": flipped,
    "empty": lambda content, other: b"",
    "other": lambda content, other: other,
    "removed": None,
}
"""What becomes of a file's content; another file of its kind is at hand. None: it is gone."""


def say(*command: str | Path) -> tuple[int, str]:
    """Exit code and all words of a command; an error that is not one of ours is raised."""
    found = CliRunner().invoke(app, [str(word) for word in command])
    if isinstance(found.exception, RoadscanError):
        return 2, f"{found.output}{found.exception}"
    if found.exception is not None and not isinstance(found.exception, SystemExit):
        raise found.exception
    return found.exit_code, found.output


@pytest.mark.slow
def test_damaged_records_are_told_in_one_go_and_mended(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store, survey = copy.store(), Survey.load(copy.survey_file)
    copied, again = [r.key for r in read_log_records(store) if r.sensor in ("profiler_left", "lidar")][:2]
    (part,) = store.files("manifest/outputs")
    broken = [part, record_path(copied), record_path(again), copy_path(again)]
    for path in broken:
        store.write_bytes(path, store.read_bytes(path)[:-50])
    faults = verify_store(store)
    assert len(faults) == 3 and all(any(path in fault for fault in faults) for path in broken[:3])
    status = survey_status(Session(survey, store))
    assert len(status.damaged) == 3 and not status.is_complete
    assert sorted(log["state"] for log in status.logs) == ["damaged"] * 2 + ["ingested"] * 7
    code, words = say("sql", "--survey", copy.survey_file, "SELECT count(*) FROM trajectory")
    assert code == 1 and words.count("not shown: ") == 3
    said = copy.run().reporter.lines
    notes = [line for line in said if line.startswith("note: ")]
    assert len(notes) == 3 and sum("its copy put in its place" in note for note in notes) == 1
    assert outputs(store) == outputs(finished.store())
    assert verify_store(store) == []
    assert survey_status(Session(survey, store)).is_complete
    assert len(store.files("damaged")) == 3


@drawn()
def test_a_log_whose_record_is_lost_is_asked_for(finished: Simulated, tmp_path: Path) -> None:
    """Where its raw log was archived, and the copy of its record is damaged as well."""
    copy = finished.copy_with_store_to(tmp_path / "survey")
    store = copy.store()
    copy.run()  # logs are known by their place
    record = next(r for r in read_log_records(store) if r.sensor == "lidar")
    for path in (record_path(record.key), copy_path(record.key)):
        store.write_bytes(path, b"{}")
    raw = copy.survey_file.parent / record.path
    raw.rename(tmp_path / "archived")
    with pytest.raises(
        RunError, match=rf"{raw.name}: the log does not exist, .*damaged/manifest/logs/.* put the log back"
    ):
        copy.run()
    (tmp_path / "archived").rename(raw)
    copy.run()
    assert Manifest(store).all() == Manifest(finished.store()).all()


@pytest.fixture(scope="module")
def made(finished: Simulated, tmp_path_factory: pytest.TempPathFactory) -> tuple[Simulated, dict[str, bytes]]:
    """A store with files of all kinds, and what it holds."""
    copy = finished.copy_with_store_to(tmp_path_factory.mktemp("damaged") / "survey")
    copy.run(**MAKE)
    return copy, outputs(copy.store())


def spoil(store: Store, damage: str) -> list[str]:
    """Damage a file of each kind, of one tile; returns their paths."""
    spoilt = []
    for kind in KINDS:
        path, *others = sorted(store.files(kind), key=lambda p: -(store.size(p) or 0))
        other = store.read_bytes(others[0]) if others else b"PAR1 or not"
        change = DAMAGES[damage]
        if change is None:
            store.remove(path)
        else:
            store.write_bytes(path, change(store.read_bytes(path), other))
        spoilt.append(path)
    return spoilt


@pytest.mark.slow
@pytest.mark.parametrize("damage", sorted(DAMAGES))
def test_damaged_files_are_found_and_made_again(made: tuple[Simulated, dict[str, bytes]], damage: str) -> None:
    copy, whole = made
    store, survey = copy.store(), changed(Survey.load(copy.survey_file), MAKE)
    spoilt = spoil(store, damage)
    cells, overviews = spoilt[:2]
    # by their sizes; bits that flipped are found by who reads the file, and footprints of all are read from one
    assert survey_status(Session(survey, store)).is_complete is (damage == "flipped")
    for table in ("cells", "overviews", "footprints", "tiles"):
        try:
            query(store, f"SELECT * FROM {table}")
        except RoadscanError as error:
            assert "`roadscan verify`" in str(error) or (damage == "removed" and "SHOW TABLES" in str(error))

    other = Session(changed(survey, {"title": "drawn anew"}), store, Inline())  # of the same tiles
    with pytest.raises(RunError) as raised:
        run_stages(other, [stage for stage in stages() if stage.name == "products"])
    for product, path in (("mosaic/height", cells), ("kilometre/height", overviews)):
        assert any(unit.startswith(product) and path in reason for _, unit, reason in other.failures)
    assert "run `roadscan verify`, which finds all such files; the next run then makes them again" in str(raised.value)

    for _ in range(2):  # what is not whole stays listed until it is made again
        faults = verify_store(store)
        assert [path for path in spoilt[:5] if not any(path in fault for fault in faults)] == []
    tile = TileId.parse(Path(cells).stem)
    beside = next(t for t in map(TileId.parse, Manifest(store).of("tile")) if t != tile)
    try:
        copy.run(selection=Selection(named=(beside,)), **MAKE)
    except RunError as error:
        assert cells in str(error)  # mosaics need it, and it was not asked for
    assert copy.run(**MAKE).failures == []
    assert outputs(store) == whole
    assert verify_store(store) == []


@pytest.mark.slow
def test_a_run_mends_what_it_stumbles_over(made: tuple[Simulated, dict[str, bytes]]) -> None:
    """Bits that flipped are not seen by a file's size: who reads them fails, and the next run makes them again."""
    copy, whole = made
    store = copy.store()
    before = whole | {path: store.read_bytes(path) for path in store.files("tables/footprints")}
    cells, _, geotiff, las, single, table = spoil(store, "flipped")
    for path in (geotiff, las, single, table):  # nobody reads these
        store.write_bytes(path, before[path])
    footprints = "manifest/joined/footprints.parquet"
    content = bytearray(store.read_bytes(footprints))
    content[len(content) // 2] ^= 1
    store.write_bytes(footprints, bytes(content))
    with pytest.raises(RoadscanError, match="not as it was recorded") as raised:
        copy.run(selection=Selection(named=(TileId(0, 0),)), **MAKE)
    assert raised.value.file == store.path(footprints)
    with pytest.raises(RunError, match=cells):
        copy.run(**MAKE, products__options={"mosaic": {"quantities": ["height"]}})
    copy.run(**MAKE)
    assert outputs(store) == whole
    assert verify_store(store) == []


@pytest.mark.slow
def test_a_folder_in_place_of_a_file_is_set_aside(made: tuple[Simulated, dict[str, bytes]]) -> None:
    copy, whole = made
    store = copy.store()
    for kind in ("tiles/cells", "products/tile_table"):
        path = store.files(kind)[0]
        store.remove(path)
        Path(store.path(path)).mkdir()
        (Path(store.path(path)) / "note.txt").write_text("mine")
        assert verify_store(store)
        copy.run(**MAKE)
        assert store.read_bytes(f"damaged/{path}/note.txt") == b"mine"
    assert outputs(store) == whole
