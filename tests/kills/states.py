"""Folders and buckets as they were at some moment, kept by content, and put back."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

import fsspec

from roadscan.store.digest import bytes_digest

OBJECTS: Final = "s3://"
"""Begins the names of objects; other names are of files below the work folder."""
BUCKET: Final = "roads"

State = dict[str, tuple[str, int]]
"""Digest and time (Unix ns; 0 of an object) of each file and object."""


class Place:
    """A work folder, with a bucket where there is one."""

    def __init__(self, work: Path, pool: Path, has_bucket: bool) -> None:
        self.work, self.pool = work, pool
        self.fs = fsspec.filesystem("s3") if has_bucket else None
        self._seen: dict[str, tuple[Any, str]] = {}
        """Stamp and digest of what was last put or taken."""
        work.mkdir(parents=True, exist_ok=True)
        pool.mkdir(parents=True, exist_ok=True)

    def stamps(self) -> dict[str, Any]:
        """What changes when a file does, by name."""
        found: dict[str, Any] = {}
        for folder, _, names in os.walk(self.work):
            for name in names:
                path = Path(folder) / name
                stat = path.lstat()
                found[path.relative_to(self.work).as_posix()] = (stat.st_size, stat.st_mtime_ns, stat.st_ino)
        if self.fs is not None:
            self.fs.invalidate_cache()
            for name, told in self.fs.find(BUCKET, detail=True).items():
                found[f"{OBJECTS}{name}"] = (told["size"], told["ETag"])
        return found

    def read(self, name: str) -> bytes:
        """Content of a file or object."""
        if name.startswith(OBJECTS):
            assert self.fs is not None
            return bytes(self.fs.cat_file(name.removeprefix(OBJECTS)))
        return (self.work / name).read_bytes()

    def kept(self, digest: str) -> Path:
        """The file of the pool that has a content."""
        return self.pool / digest.replace(":", "-")

    def take(self) -> State:
        """What is there now, kept in the pool."""
        now: State = {}
        for name, stamp in self.stamps().items():
            if (known := self._seen.get(name)) is not None and known[0] == stamp:
                digest = known[1]
            else:
                content = self.read(name)
                digest = bytes_digest(content)
                if not (kept := self.kept(digest)).exists():
                    kept.write_bytes(content)
                self._seen[name] = (stamp, digest)
            now[name] = (digest, 0 if name.startswith(OBJECTS) else stamp[1])
        return now

    def put(self, state: State) -> None:
        """Make everything as it was."""
        there = self.stamps()
        self._seen = {name: known for name, known in self._seen.items() if name in there}
        for name, stamp in there.items():
            known = self._seen.get(name)
            if name in state and known is not None and known[0] == stamp and known[1] == state[name][0]:
                continue
            if name.startswith(OBJECTS):
                assert self.fs is not None
                self.fs.rm_file(name.removeprefix(OBJECTS))
            else:
                (self.work / name).unlink()
            self._seen.pop(name, None)
        for path in sorted((p for p in self.work.rglob("*") if p.is_dir()), reverse=True):
            if not any(path.iterdir()):
                path.rmdir()
        for name, (digest, time_ns) in state.items():
            if name in self._seen and self._seen[name][1] == digest:
                continue
            self._write(name, self.kept(digest).read_bytes(), time_ns)
            self._seen[name] = (None, digest)
        for name, stamp in self.stamps().items():
            self._seen[name] = (stamp, self._seen[name][1])

    def _write(self, name: str, content: bytes, time_ns: int) -> None:
        if name.startswith(OBJECTS):
            assert self.fs is not None
            self.fs.pipe_file(name.removeprefix(OBJECTS), content)
            return
        path = self.work / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        os.utime(path, ns=(time_ns, time_ns))
