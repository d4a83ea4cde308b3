"""A store without folders, locks and renames: the same bytes, nothing twice, every command."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Iterator
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from roadscan.core.errors import RunError, StoreError, may_pass
from roadscan.core.grid import TileId
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Selection, Session
from roadscan.run.stage import stages
from roadscan.store.holders import look_of
from roadscan.store.manifest import Manifest
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from roadscan.survey.status import survey_status, verify_store
from tests.object_store import served
from tests.surveys import Lines, Simulated, outputs


class Remembering(MemoryFileSystem):
    """Objects that all clients share; each keeps the lists that it has seen, as those of S3 do."""

    protocol = "remembering"
    cachable = False  # a client a process
    store: dict[str, Any] = {}
    pseudo_dirs = [""]

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix(f"{cls.protocol}:/")))

    def find(self, path: str, *_: object, detail: bool = False, **__: object) -> Any:
        try:
            found = self.dircache[path]
        except KeyError:
            found = self.dircache[path] = super().find(path, detail=True)
        return dict(found) if detail else sorted(found)


class Breaking(Remembering):
    """The same; `break_off` raises an error in place of readings."""

    protocol = "breaking"
    break_off: Exception | None = None

    def _open(self, path: str, mode: str = "rb", *arguments: Any, **options: Any) -> Any:
        if mode == "rb" and "/tables/packed_returns/" in path and Breaking.break_off is not None:
            raise Breaking.break_off
        return super()._open(path, mode, *arguments, **options)


@pytest.fixture
def objects() -> Iterator[str]:
    """URL of an empty store."""
    fsspec.register_implementation("remembering", Remembering, clobber=True)
    yield "remembering://bucket/roads"
    Remembering.store.clear()


def run(survey: Survey, store: Store, *chosen: TileId) -> Session:
    run = Session(survey, store, Inline(), Selection(named=chosen) if chosen else None, Lines())
    run_stages(run, stages())
    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "why"), [(ConnectionResetError("reset"), "a place does not answer"), (ValueError("bad"), "")]
)
def test_a_unit_that_met_a_silent_store_may_pass(
    finished: Simulated, objects: str, monkeypatch: pytest.MonkeyPatch, fault: Exception, why: str
) -> None:
    """Its reason travels as words."""
    fsspec.register_implementation("breaking", Breaking, clobber=True)
    survey = Survey.load(finished.survey_file)
    store = Store(objects.replace("remembering:", "breaking:"), survey.config.id)
    monkeypatch.setattr(Breaking, "break_off", fault)
    with pytest.raises(RunError, match=r"failed: footprints \S+: ") as failed:
        run(survey, store)
    assert may_pass(failed.value) == why


@pytest.mark.slow
def test_a_whole_run(finished: Simulated, objects: str) -> None:
    survey, folder = Survey.load(finished.survey_file), finished.store()
    store = Store(objects, survey.config.id)
    assert not store.is_folder
    assert run(survey, store).raw_bytes_read > 0
    assert outputs(store) == outputs(folder)
    assert run(survey, store).raw_bytes_read == 0
    assert survey_status(Session(survey, store)).is_complete
    tile, damaged = [r for r in Manifest(store).of("tile").values() if r.path][:2]
    assert run(survey, store, TileId.parse(tile.unit)).raw_bytes_read > 0
    for table in ("scans", "returns", "trajectory", "cells", "tiles", "footprints", "outputs", "rejects"):
        asked = f"SELECT count(*) AS n FROM {table}"
        assert query(store, asked) == query(folder, asked), table
    store.write_bytes(damaged.path, b"cut")
    (part,) = store.files("manifest/outputs")
    assert [damaged.path in fault for fault in verify_store(store)] == [True]
    store.write_bytes(part, b"cut")
    run(survey, store)
    assert verify_store(store) == []
    assert outputs(store) == outputs(folder)
    assert store.files("damaged") == [f"damaged/{part}"]


@pytest.mark.slow
def test_an_idle_run_lists_s3_once(finished: Simulated) -> None:
    """What the run knows of the store at its end is what the store holds, and a second run asks for records alone."""
    survey = Survey.load(finished.survey_file)
    with served() as objects:
        store = Store(f"{objects.url}/roads", survey.config.id)
        with store.looked():
            run(survey, store)
            seen = look_of((store.url, store.survey_id))
            assert seen is not None
            known = dict(seen._listed())
        listed = store.fs.find(store.root, detail=True).items()
        held = {path.removeprefix(f"{store.root}/"): info["size"] for path, info in listed}
        assert held == known | {"manifest/lock": 0}  # given back since
        objects.requests.clear()
        with store.looked():
            assert run(survey, store).raw_bytes_read == 0
        assert not any("HEAD" in method and "tiles" in path for method, path in objects.requests)
        assert len(objects.requests) <= 40 < len(held)
        objects.requests.clear()
        assert verify_store(store) == []
        of_files = Counter(path for _, path in objects.requests if "/tiles/" in path or "/tables/" in path)
        assert len(of_files) > 40 and set(of_files.values()) == {1}


def test_what_a_worker_wrote_is_seen(objects: str) -> None:
    store = Store(objects, "s")
    store.write_bytes("manifest/logs/a.json", b"{}")
    assert store.files("manifest/logs") == ["manifest/logs/a.json"]
    pickle.loads(pickle.dumps(store)).write_bytes("manifest/logs/b.json", b"{}")
    assert store.files("manifest/logs") == ["manifest/logs/a.json", "manifest/logs/b.json"]


def test_a_store_that_does_not_answer_is_told(objects: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class NoCredentialsError(Exception):
        """As libraries of object stores have them."""

    def refuse(*_: object) -> None:
        raise NoCredentialsError("Unable to locate credentials")

    monkeypatch.setattr(Remembering, "exists", refuse)
    with pytest.raises(StoreError, match=rf"{objects} cannot be reached: Unable to locate credentials; .*your keys"):
        verify_store(Store(objects, "s"))
    with pytest.raises(StoreError, match="the store odd://x cannot be opened: Protocol not known"):
        Store("odd://x", "s")
