"""What is on the disk when a name becomes visible: told by a file system that remembers each call."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store


class Disk:
    """Which files and folders were brought to the disk since they last changed, by their inodes."""

    def __init__(self) -> None:
        self.synced: set[int] = set()
        self.seen: list[tuple[str, bool]] = []
        """Names that became visible, and whether all below them was on the disk."""

    def sync(self, opened: int) -> None:
        self.synced.add(os.fstat(opened).st_ino)

    def rename(self, move: Callable[..., Any], source: Path, target: str | Path) -> Any:
        whole = all(self.holds(path) for path in (source, *source.rglob("*")))
        moved = move(source, target)
        self.synced.discard(Path(target).parent.stat().st_ino)
        self.seen.append((str(target), whole))
        return moved

    def holds(self, path: str | Path) -> bool:
        """True if a file's bytes, or a folder's names, are on the disk."""
        return Path(path).stat().st_ino in self.synced


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()

    rename, replace = Path.rename, Path.replace
    monkeypatch.setattr(os, "fsync", disk.sync)
    monkeypatch.setattr(Path, "rename", lambda source, target: disk.rename(rename, source, target))
    monkeypatch.setattr(Path, "replace", lambda source, target: disk.rename(replace, source, target))
    return disk


def test_records_are_on_the_disk_before_they_are_seen(tmp_path: Path, disk: Disk) -> None:
    store = Store(str(tmp_path), "s")
    Manifest(store).add([OutputRecord("tile", "1_0", "k", "", 0, "")])
    ((name, whole),) = disk.seen
    assert whole and name == store.path("manifest/outputs/part-00000000.parquet")
    for folder in Path(name).parents:
        assert disk.holds(folder), folder
        if folder == tmp_path:
            break


def test_ingested_rows_are_on_the_disk_before_they_are_seen(tmp_path: Path, disk: Disk) -> None:
    store = Store(str(tmp_path), "s")
    with store.scratch() as folder:
        for second in (0, 60):
            part = folder / "scans" / f"gps_bin_s={second}" / "part-00000.parquet"
            part.parent.mkdir(parents=True)
            part.write_bytes(b"rows")
        store.publish_folder(folder / "scans", "tables/scans/run=r/sensor=s/log=k")
    assert disk.seen == [(store.path("tables/scans/run=r/sensor=s/log=k"), True)]
    assert disk.holds(store.path("tables/scans/run=r/sensor=s")) and disk.holds(store.path("tables/scans"))


def test_files_of_tiles_are_not_waited_for(tmp_path: Path, disk: Disk) -> None:
    store = Store(str(tmp_path), "s")
    store.write_bytes("tiles/las/0_0.laz", b"makes the folder")
    disk.synced.clear()
    with store.scratch() as folder:
        (folder / "tile.laz").write_bytes(b"points")
        store.publish(folder / "tile.laz", "tiles/las/1_0.laz")
    assert not disk.synced
