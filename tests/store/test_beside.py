"""What is made beside its place, and put there: a reader always finds one, and dead processes leave nothing."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

from roadscan.store import holders
from roadscan.store.holders import beside, put_folder


def made(place: Path, content: str) -> Path:
    folder = beside(place)
    folder.mkdir()
    (folder / "file").write_text(content)
    return folder


@pytest.mark.parametrize("can_exchange", [True, False])
def test_a_folder_takes_the_place_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    if not can_exchange:
        monkeypatch.setattr(holders, "_exchanged", lambda _one, _other: False)
    for content in ("first", "second", "third"):
        put_folder(made(tmp_path / "site", content), tmp_path / "site")
        assert (tmp_path / "site/file").read_text() == content
        assert [one.name for one in tmp_path.iterdir()] == ["site"]


def test_the_place_is_never_empty(tmp_path: Path) -> None:
    place, over, missed = tmp_path / "site", threading.Event(), list[int]()
    put_folder(made(place, "0"), place)

    def look() -> None:
        while not over.is_set():
            if not place.exists():
                missed.append(1)

    reader = threading.Thread(target=look)
    reader.start()
    for number in range(200):
        put_folder(made(place, str(number)), place)
    over.set()
    reader.join()
    assert not missed


def test_what_a_killed_process_left_goes_and_all_else_stays(tmp_path: Path) -> None:
    place = tmp_path / "site"
    child = os.fork()
    if child == 0:
        made(place, "half")
        beside(place).write_text("half a page")
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 2
    own = made(place, "of this process, which lives")
    (tmp_path / ".site-backup").mkdir()
    (tmp_path / ".site-2026-05-04-1").mkdir()
    beside(place)
    assert {one.name for one in tmp_path.iterdir()} == {own.name, ".site-backup", ".site-2026-05-04-1"}
