"""The log of the inventory: append-only commits, each with one Parquet file of rows.

    tables/assets_found/<number>-<digest>.parquet     what a run found
    tables/asset_edits/<number>-<digest>.parquet      what people changed
    tables/asset_commits/<number>.parquet             written last: it makes the rows part of the inventory
    inventory/head.json                               how many commits there are: tells that the last one is missing
    inventory/published/<token>.parquet               rows of an inventory file as published or last read

A file of rows that no commit names remained from an interrupted program; the next append removes it.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Final, Literal, TypeAlias

import pyarrow as pa

from roadscan.core.errors import DamagedError, StoreError
from roadscan.store.asset_schema import evidence_table
from roadscan.store.digest import bytes_digest, bytes_hold, checked_json, parse_checked, sealed_parquet
from roadscan.store.schema import table_schema
from roadscan.store.store import Store

try:
    import fcntl
except ImportError:  # systems without such locks
    fcntl = None  # type: ignore[assignment]

CommitKind: TypeAlias = Literal["found", "edits", "undo"]

COMMITS: Final = "tables/asset_commits"
_ROWS: Final = {"found": "tables/assets_found", "edits": "tables/asset_edits"}
_PUBLISHED: Final = "inventory/published"
_LOCK: Final = "inventory/lock"
_HEAD: Final = "inventory/head.json"
_TOKEN: Final = b"roadscan:published"
"""Metadata of published rows: the token under which they are stored."""
_POLL_S: Final = 0.05  # time between two attempts to get the lock (s)
_PUBLISH_ANEW: Final = "publish to a new home: what was changed in this one cannot be told"
_FORGET_HEAD: Final = "remove it, if the last commit is there (`roadscan inventory log`)"
_RESTORE: Final = "restore it from a copy of the store: what people changed cannot be made again"


@dataclass(frozen=True)
class Commit:
    """One commit of the inventory; `schemas/asset_commits.toml` describes its fields."""

    number: int
    kind: CommitKind
    at: str
    who: str
    why: str
    source: str
    epoch: str = ""
    epoch_gps_ns: int = 0
    run: str = ""
    undoes: int = 0
    rows: int = 0
    file: str = ""
    digest: str = ""


@dataclass(frozen=True)
class Draft:
    """A commit before it has a number and a time."""

    kind: CommitKind
    who: str
    why: str
    source: str
    epoch: str = ""
    epoch_gps_ns: int = 0
    run: str = ""
    undoes: int = 0


class AssetTruth:
    """The inventory's commits in a store, as they were when first read or after the last append."""

    def __init__(self, store: Store, units_m: tuple[float, float] = (1.0, 1.0)) -> None:
        """Take the metres in one unit of the map's coordinates, and of its heights."""
        self.store = store
        self.units_m = units_m
        self._commits: tuple[Commit, ...] | None = None

    @property
    def commits(self) -> tuple[Commit, ...]:
        """Return all commits in their order.

        Raises
        ------
        DamagedError
            where one cannot be read or is missing.
        """
        if self._commits is None:
            self._commits = tuple(self._read_commits())
        return self._commits

    def renew(self) -> None:
        """Forget what was read, because other programs may have appended."""
        self._commits = None

    def _read_commits(self) -> Iterator[Commit]:
        files = self.store.files(COMMITS, ".parquet")
        for place, file in enumerate(files, start=1):
            commit = self._read_commit(file)
            if commit.number != place:
                raise self._missing(place)
            yield commit
        if len(files) < self._known():
            raise self._missing(len(files) + 1)

    def _missing(self, number: int) -> DamagedError:
        file = self.store.path(f"{COMMITS}/{number:08d}.parquet")
        return DamagedError(f"commit {number} of the inventory is missing", change=_RESTORE, file=file)

    def _known(self) -> int:
        """Return how many commits there are at least; 0 in an inventory of an older version."""
        if not self.store.exists(_HEAD):
            return 0
        try:
            return int(parse_checked(self.store.read_bytes(_HEAD))["commits"])
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedError(
                f"the file is damaged: {error}", change=_FORGET_HEAD, file=self.store.path(_HEAD)
            ) from error

    def _read_commit(self, file: str) -> Commit:
        rows = self.store.read_table(file, change=_RESTORE).to_pylist()
        names = [f.name for f in fields(Commit)]
        if len(rows) != 1 or not rows[0].keys() >= set(names):
            raise DamagedError("the file holds no commit of the inventory", change=_RESTORE, file=self.store.path(file))
        return Commit(**{name: rows[0][name] for name in names})

    def rows(self, commit: Commit, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the rows of a commit; columns that were unknown when they were written are null.

        Raises
        ------
        DamagedError
            where they are not those that were written.
        """
        content = self.store.read_bytes(commit.file)
        if not bytes_hold(content, commit.digest):
            raise DamagedError(
                f"rows of commit {commit.number} of the inventory are not those that were written",
                change=_RESTORE,
                file=self.store.path(commit.file),
            )
        rows = self.store.parse_table(content, commit.file, columns, change=_RESTORE)
        if columns is not None:
            return rows
        known, count = set(rows.column_names), rows.num_rows
        fields = list(_schema_of(commit.kind))
        return pa.table({f.name: rows[f.name] if f.name in known else pa.nulls(count, f.type) for f in fields})

    def faults(self) -> list[str]:
        """Return the faults of the inventory's files, each with its name; reads all of them."""
        found: list[str] = []
        numbers: list[int] = []
        for file in self.store.files(COMMITS, ".parquet"):
            try:
                commit = self._read_commit(file)
                numbers.append(commit.number)
                if commit.file:
                    self.rows(commit)
            except StoreError as error:
                found.append(str(error))
        known = 0
        try:
            known = self._known()
        except StoreError as error:
            found.append(str(error))
        gaps = sorted(set(range(1, max([known, *numbers]) + 1)) - set(numbers))
        found += [f"{COMMITS}/{n:08d}.parquet: commit {n} of the inventory is missing; {_RESTORE}" for n in gaps]
        for file in self.store.files(_PUBLISHED, ".parquet"):
            try:
                self._published(file)
            except StoreError as error:
                found.append(str(error))
        return found

    @contextlib.contextmanager
    def alone(self, wait_s: float = 30.0) -> Iterator[None]:
        """Lock out other writers of this inventory, waiting for one that is writing.

        The system releases the lock when its process ends, however it ends.

        Raises
        ------
        StoreError
            where another one is still at work after `wait_s`.
        """
        if not self.store.is_folder or fcntl is None:
            self._count_last()
            yield
            return
        file = Path(self.store.path(_LOCK))
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            opened = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise StoreError(
                f"the inventory cannot be written: {error.strerror}", change="see to its rights", file=file
            ) from error
        try:
            _take(opened, file, time.monotonic() + wait_s)
            self.store.clear_staging()
            self.renew()
            self._count_last()
            yield
        finally:
            os.close(opened)

    def _count_last(self) -> None:
        """Count the last commit, too, where its writer was killed before it did."""
        with contextlib.suppress(DamagedError):  # who reads the commits is told
            if self._known() < len(self.commits):
                self._count(len(self.commits))

    def _count(self, commits: int) -> None:
        self.store.write_bytes(_HEAD, checked_json({"commits": commits}))

    def append(self, draft: Draft, rows: pa.Table | None = None) -> Commit:
        """Append a commit, which is on the disk on return; call it within :meth:`alone`."""
        number = len(self.commits) + 1
        self._clear(number)
        file = digest = ""
        if rows is not None:
            schema = _schema_of(draft.kind)
            stamped = rows.set_column(
                rows.schema.get_field_index("commit"), "commit", pa.array([number] * rows.num_rows, pa.int32())
            )
            content = _content(stamped.select(schema.names).cast(schema))
            digest = bytes_digest(content)
            file = f"{_ROWS[draft.kind]}/{number:08d}-{digest.rpartition(':')[2][:12]}.parquet"
            self.store.write_bytes(file, content)
        commit = Commit(
            number, at=self._now(), rows=0 if rows is None else rows.num_rows, file=file, digest=digest, **asdict(draft)
        )
        schema = table_schema("asset_commits").arrow()
        name = f"{COMMITS}/{number:08d}.parquet"
        if self.store.exists(name):
            raise StoreError(
                "another program appended to the inventory", change="try again", file=self.store.path(name)
            )
        self.store.write_bytes(name, _content(pa.Table.from_pylist([asdict(commit)], schema)))
        self._count(number)
        self._commits = (*self.commits, commit)
        return commit

    def _now(self) -> str:
        now = dt.datetime.now(dt.UTC)
        if self.commits:
            now = max(now, dt.datetime.fromisoformat(self.commits[-1].at) + dt.timedelta(microseconds=1))
        return now.isoformat(timespec="microseconds").replace("+00:00", "Z")

    def _clear(self, number: int) -> None:
        for folder in _ROWS.values():
            for file in self.store.files(folder):
                stated = file.rpartition("/")[2].split("-")[0]
                if stated.isdigit() and int(stated) >= number:
                    self.store.remove(file)

    def keep_published(self, token: str, rows: pa.Table) -> None:
        """Store the rows of an inventory file under the token that it carries."""
        stamped = rows.replace_schema_metadata({_TOKEN: token})
        self.store.write_bytes(f"{_PUBLISHED}/{token}.parquet", _content(stamped))

    def published(self, token: str) -> pa.Table | None:
        """Return the rows of an inventory file as published or last read; None where this inventory did not make it."""
        file = f"{_PUBLISHED}/{token}.parquet"
        if "/" in token or not self.store.exists(file):
            return None
        return self._published(file)

    def _published(self, file: str) -> pa.Table:
        rows = self.store.read_table(file, change=_PUBLISH_ANEW)
        token = file.rpartition("/")[2].removesuffix(".parquet")
        stated = (rows.schema.metadata or {}).get(_TOKEN, token.encode())
        if stated != token.encode():
            raise DamagedError(
                "the file holds the rows of another publication", change=_PUBLISH_ANEW, file=self.store.path(file)
            )
        return rows


def _schema_of(kind: CommitKind) -> pa.Schema:
    """Return the columns of the rows of a commit."""
    return evidence_table() if kind == "found" else table_schema("asset_edits").arrow()


def _content(table: pa.Table) -> bytes:
    return sealed_parquet(table, compression="zstd", row_group_size=65_536, version="2.6")


def _take(opened: int, file: Path, until: float) -> None:
    while True:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= until:
                raise StoreError(
                    "another program is writing the inventory", change="try again when it has ended", file=file
                ) from None
            time.sleep(_POLL_S)
