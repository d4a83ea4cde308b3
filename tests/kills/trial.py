"""A draw: a command is killed some times, a reader looks after each kill, and at last the command is done."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from roadscan.site.site import KEYS
from roadscan.store.digest import bytes_digest, parse_checked
from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest, is_changing
from roadscan.store.store import Store
from roadscan.survey.archive import Archive
from roadscan.survey.forgotten import forgotten_pictures
from tests.kills.states import Place, State
from tests.kills.steps import ARCHIVE, ON_DASK, SURVEY, Base, Guest, Step, other_of, records_of, store_of

MOST_KILLS: Final = 6
"""Most kills of a draw: each begins where the one before it left."""
READERS: Final = (
    ("verify", SURVEY), ("status", SURVEY), ("inventory", "status", SURVEY),
    ("sql", "SELECT count(*) AS n FROM trajectory", "--survey", SURVEY),
)  # fmt: skip
"""Commands that look, of which one is drawn after every other kill, for they cost as much as a kill."""
VOLATILE: Final = ("manifest/verified.parquet", "manifest/lock")
"""Ends of names of files that tell of the last command."""
RECORDED: Final = ("manifest/history/", "manifest/outputs/")
"""Parts of names of files of which there are more after more runs; the records are compared one by one."""
SOURCES: Final = ("manifest/sources.json", "manifest/sources_copy.json")
"""Ends of names of files that hold times of raw files."""
SHOWN: Final = ("inventory/published/", "inventory.gpkg")
"""Parts of names of files that bear a publication: there is one more where a command was killed when it was done."""


@dataclass
class Draw:
    """What came of a draw."""

    number: int
    step: str
    kills: list[str] = field(default_factory=list)
    """When it was killed, in words."""
    faults: list[str] = field(default_factory=list)
    """What was half done, refused or different."""

    def line(self) -> str:
        """It in a line."""
        state = "; ".join(self.faults) if self.faults else "same"
        kills = f"{len(self.kills)} kills ({', '.join(self.kills)})"
        return f"{self.number:5} {'BAD ' if self.faults else ''}{self.step}: {kills}: {state}"


def draws(place: Place, base: Base, runs: Guest, seed: int, numbers: range, only: str = "") -> Iterator[Draw]:
    """Draw a step, and how it is killed, for each number."""
    steps = [step for step in base.steps if only in step.name]
    weights = np.array([step.weight for step in steps])
    for number in numbers:
        random = np.random.default_rng([seed, number])
        step = steps[int(random.choice(len(steps), p=weights / weights.sum()))]
        draw = Draw(number, step.name)
        place.put(base.states[step.before])
        try:
            _try(place, base, runs, step, random, draw)
        except Exception as error:  # noqa: BLE001 — a look that fails is a find, and the others are drawn
            draw.faults.append(f"{type(error).__name__}: {error}")
        yield draw


def _try(place: Place, base: Base, runs: Guest, step: Step, random: np.random.Generator, draw: Draw) -> None:
    before = base.states[step.before]
    gone = step.before.removeprefix("without ") if step.before.startswith("without ") else "?"
    for _ in range(int(random.integers(1, MOST_KILLS + 1))):
        by_writes, share = random.random() < 0.5 and step.writes > 0, random.random()
        looks = random.random() < 0.5
        reader = READERS[int(random.integers(len(READERS)))]
        kill = {"writes": 1 + int(share * step.writes)} if by_writes else {"seconds": share * step.seconds}
        if step.command == ON_DASK:
            kill = {"wall_s": share * step.seconds, "of_worker": by_writes}
        answer = runs.ask(step.command, **kill)
        if answer["killed"] or answer["ended"] == "killed":
            draw.kills.append(" ".join(f"{name} {value:.4g}" for name, value in kill.items()))
        if answer["left"]:
            draw.faults.append(f"after {draw.kills[-1]}: {answer['left']} workers live on")
        if answer["ended"] != "killed" and not (answer["killed"] and answer["ended"] == "2"):  # it named what it lost
            break
        draw.faults += [f"after {draw.kills[-1]}: {one}" for one in look(place, before, gone)]
        if not looks:
            continue
        answer = runs.ask(reader)
        lost = gone != "?" and reader[0] == "verify"  # it was taken away
        if answer["ended"] not in ("0", "1") or "Traceback" in runs.said() or ("damage" in runs.said() and not lost):
            draw.faults.append(f"after {draw.kills[-1]}: {reader[0]} ends with {answer['ended']}: {_last(runs.said())}")
    else:
        answer = runs.ask(step.command)
    if answer["ended"] != "0" and not (draw.kills and "is undone already" in runs.said()):
        draw.faults.append(f"not killed, it ends with {answer['ended']}: {_last(runs.said())}")
        return
    draw.faults += look(place, before)
    draw.faults += differences(place, base.states[step.after])
    if records_of(place) != step.records:
        draw.faults.append("records differ")


def look(place: Place, before: State, gone: str = "?") -> list[str]:
    """What is half done, as a reader who takes no lock finds it."""
    faults = list(store_faults(store_of(place), gone))
    site = place.work / "site"
    if (site / KEYS).exists():
        digests = parse_checked((site / KEYS).read_bytes())["digests"]
        faults += [f"site/{name} is not whole" for name, d in digests.items() if _digest(site / name) != d]
    elif f"site/{KEYS}" in before:
        faults.append("the site is gone")
    for name in ("page.html", "inventory.gpkg"):
        if name in before and not (place.work / name).exists():
            faults.append(f"{name} is gone")
    if (home := place.work / "inventory.gpkg").exists():
        with sqlite3.connect(f"file:{home}?mode=ro", uri=True) as database:
            (said,) = database.execute("PRAGMA integrity_check").fetchone()
        faults += [f"inventory.gpkg: {said}"] if said != "ok" else []
    faults += _archive_faults(place)
    return faults


def store_faults(store: Store, gone: str) -> Iterator[str]:
    """What records name is there, in its size, or was taken away before the command."""
    for record in read_log_records(store):
        for file in (one for own in record.tables.values() for one in own):
            if store.size(file.path) != file.bytes:
                yield f"{file.path}: {store.size(file.path)} bytes, recorded {file.bytes}"
    for output in Manifest(store).all():
        size = store.size(output.path) if output.path else output.bytes
        behind = size is not None and is_changing(store)  # the file is whole, and its record comes next
        if size != output.bytes and not behind and not (size is None and output.path.startswith(gone)):
            yield f"{output.path}: {size} bytes, recorded {output.bytes}"


def _archive_faults(place: Place) -> Iterator[str]:
    url = ARCHIVE.format(other=other_of(place))
    kept = Archive(url if "://" in url else str(place.work / "archive"))
    gone = {one.path for one in forgotten_pictures(store_of(place))}
    for at, of in kept.files().items():
        if of["path"] not in gone and kept.digest(at) != of["digest"]:
            yield f"archive/{at} is not whole"
    for log in sorted((place.work / "survey/raw").rglob("*.jpg")):
        if not log.read_bytes().endswith(b"\xff\xd9"):
            yield f"{log.name} is cut short"


def differences(place: Place, expected: State) -> list[str]:
    """Names of files that are not as an undisturbed command leaves them, with what is wrong."""
    now = place.take()
    found = []
    for name in sorted(now.keys() | expected.keys()):
        if name.endswith(VOLATILE) or any(part in name for part in RECORDED):
            continue
        if SHOWN[0] in name and (name in now) != (name in expected):
            continue
        if name not in now:
            found.append(f"{name} is missing")
        elif name not in expected:
            found.append(f"{name} is left over")
        elif now[name][0] != expected[name][0] and _content(place, name, now) != _content(place, name, expected):
            found.append(f"{name} differs")
    return found


def _content(place: Place, name: str, state: State) -> Any:
    """What a file holds, without what differs from call to call."""
    file = place.kept(state[name][0])
    if name.endswith(SOURCES):
        told = json.loads(file.read_bytes())
        return {n: {f: [of[0], *of[2:]] for f, of in one["files"].items()} for n, one in told.items() if "files" in one}
    if name.endswith(SHOWN[1]):
        with sqlite3.connect(f"file:{file}?mode=ro", uri=True) as database:
            tables = [row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            layers = [one for one in tables if not one.startswith(("gpkg_", "rtree_", "sqlite_", "roadscan_inventory"))]
            return {one: sorted(map(repr, database.execute(f'SELECT * FROM "{one}"'))) for one in layers}
    return file.read_bytes()


def _digest(path: Path) -> str:
    return bytes_digest(path.read_bytes()) if path.is_file() else ""


def _last(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return " | ".join(lines[-2:])[:400]
