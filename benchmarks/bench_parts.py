"""Where the nanoseconds of a default run go: stages and their parts, on each class of processor, beside memory.

One process computes a drive's stages, once to compile and load the kernels and `repeats` times more; functions are
wrapped, and each counts its own processor time without that of the others that it calls.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks import surveys
from benchmarks.measured_run import Way, processors
from benchmarks.roofline import triad_bytes_per_s
from benchmarks.settings import Settings, bench_folder
from benchmarks.timing import Figure
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.engine.compute_on import MEMORY_KEPT
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.store import Store
from roadscan.survey.run import run_stage
from roadscan.tiles.product import TileProduct, products

STAGES = ("ingest", "navigate", "footprints", "strips", "adjust", "tiles", "products")
"""Stages that are looked at: what else a default run does takes next to nothing of these drives."""
_PARTS = {
    "read and checked": ("roadscan.ingest.ingest:_items",),
    "written": ("roadscan.store.writer:LogWriter._write", "roadscan.store.writer:LogWriter.publish"),
    "read and decoded": ("roadscan.store.readings.row_groups:GroupReader.read",),
    "placed and counted": (
        "roadscan.tiles.accumulator:Accumulator.run",
        "roadscan.tiles.accumulator:Accumulator.fill",
    ),
    "points placed": (
        "roadscan.georeference.place:Placement.returns",
        "roadscan.georeference.place:Placement.profiles",
    ),
    "points joined and ordered": ("roadscan.tiles.tasks.tiles:load_tiles",),
    "cells finished": ("roadscan.tiles.accumulator:Accumulator.finish",),
    "cells.parquet": ("roadscan.tiles.tasks.tiles:write_cells",),
    "overviews": ("roadscan.tiles.tasks.tiles:write_overviews", "roadscan.tiles.product:pyramid_of"),
    "digests, renames": ("roadscan.tiles.tasks.tiles:publish_file", "roadscan.tiles.product:publish_product"),
}
"""Functions, and methods of classes, by the part that they are."""
_BYTES = {
    "pair: ingest, read and checked": 3.0,
    "pair: ingest, written": 2.12,
    "pair: tiles, read and decoded": 2.12,
    "pair: tiles, placed and counted": 2.0,
    "pair: tiles, cells finished": 2.0 + 52 / 25,
    "pair: tiles, cells.parquet": (52 + 27.5) / 25,
    "hdl32e: ingest, read and checked": 3.75,
    "hdl32e: ingest, written": 2.8,
    "hdl32e: tiles, read and decoded": 2.8,
    "hdl32e: tiles, points placed": 33.0,
    "hdl32e: tiles, points joined and ordered": 3 * 33.0,
    "hdl32e: tiles, las": 2 * 30.0 + 7.6,
}
"""Bytes a reading that a part moves from or to memory at the least: what is smaller than a row group stays in a cache.

A reading of a profile is 3 bytes in the log, 2.12 stored, 2 in a slot of its cell; a cell of 25 readings has 52 bytes,
27.5 in its file. A return is 3.75 bytes in the log, 2.8 stored, 33 on the map (written, read and written where tiles
are joined), 30 in LAS, 7.6 in LAZ.
"""
_LEAST_NS = {"pair": 0.05, "hdl32e": 1.0}
"""Parts that take less of a reading are left out (ns)."""


def figures(folder: Path) -> Iterator[Figure]:
    """The pair, then the HDL-32E."""
    size, kept = Settings.current(), bench_folder(folder)
    bandwidth = triad_bytes_per_s(1)
    yield Figure("this machine: triad, 1 thread", bandwidth / 1e9, "GB/s")
    for name, length in (("pair", size.pair_m), ("hdl32e", size.hdl_s)):
        survey = getattr(surveys, name)(kept, length)
        for processor in processors():
            command = [sys.executable, "-m", "benchmarks.bench_parts", str(survey.file), str(folder / "parts")]
            command.append(str(size.repeats))
            environment = Way(processor).environment | {name: str(value) for name, value in MEMORY_KEPT.items()}
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            for part, seconds in json.loads(done.stdout.splitlines()[-1]).items():
                ns = 1e9 * seconds / survey.readings
                least = _BYTES.get(f"{name}: {part}")
                if ns >= _LEAST_NS[name]:
                    limit = None if least is None else 1e9 * least / bandwidth
                    against = "" if least is None else f"memory: {least:.3g} bytes"
                    yield Figure(f"{name}, {processor}: {part}", ns, "ns", limit, against)


class _Clock:
    """Processor time by part; a part does not count while another runs inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.stage = ""
        self._running: list[str] = []
        self._since = time.process_time()

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count what is done here as a part."""
        self._turn()
        self._running.append(name)
        try:
            yield
        finally:
            self._turn()
            self._running.pop()

    def _turn(self) -> None:
        now = time.process_time()
        if self._running:
            self.seconds[f"{self.stage}, {self._running[-1]}"] += now - self._since
        self._since = now

    def wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function, or one that returns an iterator, that counts as a part."""

        def counted(*given: Any, **named: Any) -> Any:
            with self.part(name):
                found = function(*given, **named)
            return self._each(name, found) if isinstance(found, Iterator) else found

        return counted

    def _each(self, name: str, items: Iterator[Any]) -> Iterator[Any]:
        end = object()
        while True:
            with self.part(name):
                item = next(items, end)
            if item is end:
                return
            yield item


def _wrap(clock: _Clock) -> None:
    """Wrap the functions of all parts, and each product."""
    for name, places in _PARTS.items():
        for place in places:
            module, _, path = place.partition(":")
            owner: Any = importlib.import_module(module)
            *within, last = path.split(".")
            for one in within:
                owner = getattr(owner, one)
            setattr(owner, last, clock.wrapped(name, getattr(owner, last)))
    for name, product in products().items():
        if isinstance(product, TileProduct):
            kind: Any = type(product)
            kind.write = clock.wrapped(name, kind.write)


def main() -> None:
    """Print the median seconds of each part of SURVEY.toml, with stores at STORE, over so many runs, as JSON."""
    survey, folder, repeats = Survey.load(Path(sys.argv[1])), Path(sys.argv[2]), int(sys.argv[3])
    clock, found = _Clock(), []
    _wrap(clock)
    for _ in range(1 + repeats):
        clock.seconds.clear()
        session = Session(survey, Store(str(folder), survey.config.id), Inline())
        with session.store.lock():
            for stage in stages():
                if stage.name in STAGES:
                    clock.stage = stage.name
                    with clock.part("all else"):
                        run_stage(session, stage)
        shutil.rmtree(folder)
        found.append(dict(clock.seconds))
    parts = dict.fromkeys(name for one in found[1:] for name in one)
    print(json.dumps({name: median(one.get(name, 0.0) for one in found[1:]) for name in parts}))


if __name__ == "__main__":
    main()
