"""One damaged file through the public door, and all that has to hold whatever its bytes are."""

from __future__ import annotations

import contextlib
import random
import resource
import shutil
import signal
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pyarrow as pa

from roadscan.core.errors import RoadscanError
from roadscan.core.witness import Finding
from roadscan.ingest.reading.format import LogFormat, LogSource, Reject, Rows, format_named, log_formats
from roadscan.store.schema import table_schema
from tests.fuzz.mutations import changed
from tests.fuzz.samples import Sample

MEMORY_MB = 96.0
"""A reader may take so much memory beyond what it needs for a sound file …"""
MEMORY_FACTOR = 8.0
"""… and so many times the bytes of the file."""
ADDRESS_SPACE = 3 << 30
"""Fence: what a process may claim in all while a damaged file is read."""
SLOWEST_S = 20.0
FIRST_REJECTS = 1000
LARGEST_CHUNK_ROWS = 1 << 18
LARGEST_CHUNK_BYTES = 12 << 20


class Broken(Exception):
    """A reader did what no reader may."""


class _TooSlow(BaseException):
    pass


@dataclass
class Read:
    """All that a log yielded."""

    tables: dict[str, pa.Table] = field(default_factory=dict)
    rejects: list[Reject] = field(default_factory=list)
    """The first of them."""
    rejected: int = 0
    """Records in all of them."""

    @property
    def rows(self) -> int:
        return sum(t.num_rows for t in self.tables.values())

    def reject(self, reject: Reject) -> None:
        self.rejected += reject.records
        if len(self.rejects) < FIRST_REJECTS:
            self.rejects.append(reject)


@dataclass(frozen=True)
class Outcome:
    """What came of one damaged file."""

    number: int
    form: str
    verdict: str
    """refused, rejects, clean, or failed."""
    ms: float
    peak_mb: float
    fewer: bool = False
    """Read clean, but with fewer rows than the sound file holds."""
    claimed_by: tuple[str, ...] = ()
    """Other formats whose content test it passes."""
    said: str = ""
    """What the reader said, or did wrong."""


# --- reading ----------------------------------------------------------------------------------------


def read(log_format: LogFormat, source: LogSource) -> Read:
    """Read a log as ingest does, and check everything that comes out of it."""
    header = log_format.header(source)
    out = Read()
    batches: dict[str, list[pa.RecordBatch]] = {}
    for item in log_format.read(source, header):
        if isinstance(item, Reject):
            _check_reject(item)
            out.reject(item)
            continue
        if isinstance(item, Finding):
            continue
        batches.setdefault(item.table, []).append(_checked(log_format, item, header.list_size))
    for name, parts in batches.items():
        out.tables[name] = pa.Table.from_batches(parts, table_schema(name).arrow(header.list_size))
    return out


def _checked(log_format: LogFormat, item: Rows, list_size: int | None) -> pa.RecordBatch:
    if item.table not in log_format.yields:
        raise Broken(f"rows of the table {item.table}, which the format does not fill")
    if not 0 < item.batch.num_rows <= LARGEST_CHUNK_ROWS or item.batch.nbytes > LARGEST_CHUNK_BYTES:
        raise Broken(f"a chunk of {item.batch.num_rows} rows and {item.batch.nbytes} bytes")
    schema = table_schema(item.table)
    batch = schema.conform(item.batch, list_size)
    faults = schema.faults(batch)
    if faults:
        raise Broken(f"rows that do not fit the table {item.table}: {faults[0][1]}")
    return batch


def _check_reject(reject: Reject) -> None:
    if reject.records < 1 or not reject.reason or reject.record < -1 or reject.offset < -1:
        raise Broken(f"a reject that says nothing: {reject}")
    if max(reject.records, reject.record, reject.offset) >= 1 << 63:
        raise Broken(f"a reject that fits no table: {reject}")


# --- one damaged file -------------------------------------------------------------------------------


class Fuzzer:
    """Damages one sample again and again.

    Parameters
    ----------
    folder : empty folder to work in.
    """

    def __init__(self, sample: Sample, folder: Path, seed: int = 0) -> None:
        self.sample = sample
        self._folder = folder
        self._seed = seed
        self._format = format_named(sample.format)
        seed_folder = folder / "sound"
        seed_folder.mkdir(parents=True)
        log = sample.make(seed_folder)
        self._log = log.relative_to(seed_folder)
        self._files = {
            p.relative_to(seed_folder): p.read_bytes() for p in sorted(seed_folder.rglob("*")) if p.is_file()
        }
        self._targets = self._damaged_files(seed_folder)
        self.sound = self._read(seed_folder)
        self.sound = self._read(seed_folder)  # once more: compiled, cached

    def _damaged_files(self, folder: Path) -> list[Path]:
        patterns = self.sample.damaged or (self._log.as_posix(),)
        found = [p.relative_to(folder) for pattern in patterns for p in sorted(folder.glob(pattern)) if p.is_file()]
        if not found:
            raise Broken(f"{self.sample.name}: no file to damage")
        return found

    def _read(self, folder: Path) -> Read:
        sample = self.sample
        options = self._format.options.parse(sample.options)
        return read(self._format, LogSource(folder / self._log, options, **sample.stated))

    @property
    def content(self) -> bytes:
        """Bytes of the file that is damaged (the first, where there are more)."""
        return self._files[self._targets[0]]

    def damaged(self, number: int) -> tuple[Path, bytes]:
        """File `number` of this seed: which one, and its bytes."""
        rng = random.Random(f"{self._seed}/{self.sample.name}/{number}")
        target = rng.choice(self._targets)
        text = self.sample.text and target.suffix not in {".log", ".shp", ".shx", ".dbf"}
        data = changed(self._files[target], rng, text=text, fields=self.sample.fields, inside=self.sample.inside)
        return target, data

    def run(self, number: int) -> Outcome:
        """Read damaged file `number`; never raises."""
        target, data = self.damaged(number)
        return self.outcome(number, target, data)

    def outcome(self, number: int, target: Path, data: bytes) -> Outcome:
        """Read the log with `data` for its file `target`."""
        folder = self._written(f"{number}", {target: data})
        size = sum(len(b) for p, b in self._files.items() if p != target) + len(data)
        try:
            return self._judged(number, folder, data, size, in_place=len(data) == len(self._files[target]))
        finally:
            shutil.rmtree(folder)

    def _written(self, name: str, other: dict[Path, bytes]) -> Path:
        folder = self._folder / name
        for path, content in (self._files | other).items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)
        return folder

    def _judged(self, number: int, folder: Path, data: bytes, size: int, *, in_place: bool) -> Outcome:
        before = reset_peak_mb()
        start = time.perf_counter()
        log: Read | None = None
        claimed: tuple[str, ...] = ()
        try:
            with bounded():
                claimed = tuple(name for name, f in log_formats().items() if f.sniff(folder / self._log))
                verdict, said, log = self._tried(folder)
            if log is not None:
                self._count(log, data)
        except Broken as fault:
            verdict, said = "failed", str(fault)
        except _TooSlow:
            verdict, said = "failed", f"took over {SLOWEST_S} s\n{traceback.format_exc(limit=-4)}"
        except Exception:  # noqa: BLE001 — whatever it is, it is a finding
            verdict, said = "failed", traceback.format_exc(limit=-6)
        ms = 1e3 * (time.perf_counter() - start)
        peak = max(0.0, peak_mb() - before)
        if peak > MEMORY_MB + MEMORY_FACTOR * size / 1e6 and verdict != "failed":
            verdict, said = "failed", f"took {peak:.0f} MB for a file of {size / 1e6:.2f} MB"
        fewer = verdict == "clean" and log is not None and log.rows < self.sound.rows
        others = tuple(name for name in claimed if name != self.sample.format)
        return Outcome(number, self.sample.form, verdict, ms, peak, fewer and in_place, others, said)

    def _tried(self, folder: Path) -> tuple[str, str, Read | None]:
        try:
            log = self._read(folder)
        except RoadscanError as error:
            if not str(error):
                raise Broken("an error without a message") from error
            return "refused", str(error), None
        return ("rejects" if log.rejects else "clean"), "; ".join(sorted({r.reason for r in log.rejects})), log

    def _count(self, log: Read, data: bytes) -> None:
        """All records that the bytes hold are read or rejected."""
        if self.sample.held is None or self.sample.damaged:
            return
        held, found = self.sample.held(data), log.rows // self.sample.reads + log.rejected
        if held not in (None, found):
            raise Broken(f"{held} records in the file, {log.rows} rows and {log.rejected} rejects")


# --- one damaged record -----------------------------------------------------------------------------


def damaged_record(fuzzer: Fuzzer, rng: random.Random) -> tuple[int, bytes]:
    """Damage inside one record: its number, and the file."""
    sample, data = fuzzer.sample, fuzzer.content
    assert sample.spans is not None
    spans = sample.spans(data)
    k = rng.randrange(len(spans))
    first, end = spans[k]
    record = bytearray(data[first:end])
    if sample.text:
        fresh = changed(bytes(record), rng, text=True).replace(b"\n", b"").replace(b"\r", b"")[: 1 << 15]
        record = bytearray(fresh.replace(b'"', b"'") if rng.random() < 0.5 else fresh)
        record = record or bytearray(b"x")
    elif rng.random() < 0.5:
        for _ in range(rng.choice((1, 2, 8))):
            record[rng.randrange(len(record))] = rng.randrange(256)
    else:
        at = rng.randrange(len(record))
        piece = rng.choice((b"\xff" * 8, bytes(8), rng.randbytes(8), b"\x00\x00\x00\x00\x00\x00\xf8\x7f", b"\x7f" * 4))
        record[at : at + len(piece)] = piece[: len(record) - at]
    return k, data[:first] + bytes(record) + data[end:]


def others_differ(fuzzer: Fuzzer, k: int, data: bytes) -> str:
    """How the rows of records other than `k` differ from those of the sound file; "" where they do not.

    A log that is refused as a whole changes nothing without a word.
    """
    assert fuzzer.sample.spans is not None
    count = len(fuzzer.sample.spans(fuzzer.content))
    folder = fuzzer._written("record", {fuzzer._targets[0]: data})
    try:
        log = fuzzer._read(folder)
    except RoadscanError:
        return ""
    finally:
        shutil.rmtree(folder)
    for name, sound in fuzzer.sound.tables.items():
        each = sound.num_rows // count
        if each * count != sound.num_rows:
            raise Broken(f"{fuzzer.sample.name}: {sound.num_rows} rows of {count} records")
        found = log.tables.get(name, sound.slice(0, 0))
        before, after = k * each, (count - 1 - k) * each
        if found.num_rows < before + after:
            if log.rejected:
                lost = before + after - found.num_rows
                return f"{name}: {lost} rows of sound records are rejected: {log.rejects}"
            return f"{name}: {found.num_rows} rows, {before + after} of them untouched, and no reject"
        if not _same(found.slice(0, before), sound.slice(0, before)):
            return f"{name}: rows before record {k} differ"
        if not _same(found.slice(found.num_rows - after), sound.slice(sound.num_rows - after)):
            return f"{name}: rows behind record {k} differ"
    return ""


def _same(a: pa.Table, b: pa.Table) -> bool:
    """Equal to the bit (NaN is NaN)."""
    return all(_bits(x) == _bits(y) for x, y in zip(a.columns, b.columns, strict=True))


def _bits(column: pa.ChunkedArray) -> list[Any]:
    if pa.types.is_floating(column.type):
        return [None if v is None else np.float64(v).tobytes() for v in column.to_pylist()]
    return list(column.to_pylist())


# --- bounds -----------------------------------------------------------------------------------------


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Time limit, and a fence about memory; warnings are errors."""

    def give_up(_: int, __: FrameType | None) -> None:
        raise _TooSlow

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, give_up)
    other_s = signal.setitimer(signal.ITIMER_REAL, SLOWEST_S)[0]
    start = time.monotonic()
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + ADDRESS_SPACE, hard))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", ResourceWarning)
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        if other_s:  # the test's own limit
            signal.setitimer(signal.ITIMER_REAL, max(0.001, other_s - (time.monotonic() - start)))
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def reset_peak_mb() -> float:
    """Resident memory now (MB); the peak is counted from here."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_mb()


def peak_mb() -> float:
    """Peak of resident memory since :func:`reset_peak_mb` (MB)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1e3
    return 0.0


# --- summary ----------------------------------------------------------------------------------------


@dataclass
class Summary:
    """Outcomes of one format."""

    outcomes: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    slowest: Outcome | None = None
    peak_mb: float = 0.0
    fewer: list[Outcome] = field(default_factory=list)
    failures: list[Outcome] = field(default_factory=list)
    claimed: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: Outcome) -> None:
        self.outcomes += 1
        self.verdicts[outcome.verdict] += 1
        if self.slowest is None or outcome.ms > self.slowest.ms:
            self.slowest = outcome
        self.peak_mb = max(self.peak_mb, outcome.peak_mb)
        self.claimed.update(outcome.claimed_by)
        if outcome.verdict == "failed":
            self.failures.append(outcome)
        elif outcome.fewer:
            self.fewer.append(outcome)
