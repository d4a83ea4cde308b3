"""A trial: one file of a survey's stores is damaged, and the next command that rests on it is asked."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import shutil
import signal
import traceback
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from typer.testing import CliRunner

from roadscan.core.errors import RoadscanError
from roadscan.store.digest import file_digest

FAULTS: Final = ("flip", "truncate", "delete", "swap")
LONGEST_S: Final = 300
"""A command that lasts longer has failed (s)."""
SURVEY: Final = "2026-spring/SURVEY.toml"
VOLATILE: Final = ("manifest/verified.parquet", "/lock")
"""Ends of names of files that tell of the last command, and hold no figure."""
HISTORY: Final = "manifest/history/"
"""Folder in which each run leaves a file of its own."""


@dataclass(frozen=True)
class Trial:
    """What came of one fault."""

    number: int
    file: str
    fault: str
    """What was done to the file, in words."""
    command: str
    state: str
    """harmless, named, refused, mended, or SILENT, CRASH, TRACEBACK."""
    words: str = ""

    @property
    def is_bad(self) -> bool:
        """True for a state in capitals."""
        return self.state.isupper()


@dataclass(frozen=True)
class Answer:
    """What a command said and left."""

    code: int
    """Exit code; negative the signal that ended it; 2 for an error in words."""
    text: str
    files: dict[str, str]
    """Digests of the files that it leaves, of those that the judgement looks at."""
    failed: str = ""
    """A traceback."""


class Tree:
    """A folder, and what it was at first: each trial begins with that."""

    def __init__(self, base: Path, work: Path) -> None:
        self.base, self.work = base, work
        shutil.copytree(base, work, copy_function=shutil.copy2, symlinks=True)
        self.known = self._stamps()
        """Size and time of each file."""
        self.digests = {name: file_digest(base / name) for name in self.known}

    def restore(self) -> None:
        """Make all files what they were."""
        now = self._stamps()
        for name in now.keys() - self.known.keys():
            (self.work / name).unlink()
        for name, stamp in self.known.items():
            if now.get(name) != stamp:
                (self.work / name).parent.mkdir(parents=True, exist_ok=True)
                (self.work / name).unlink(missing_ok=True)
                shutil.copy2(self.base / name, self.work / name)
        # Another inode or mode says nothing: names, sizes and times do.

    def changed(self) -> dict[str, str]:
        """Return digests of the files that differ now from what they were; "" for one that is gone."""
        now = self._stamps()
        found = dict.fromkeys(self.known.keys() - now.keys(), "")
        for name, stamp in now.items():
            if self.known.get(name) == stamp:
                continue
            digest = file_digest(self.work / name)
            if self.digests.get(name) != digest:
                found[name] = digest
        kept = (name for name in found if not name.endswith(VOLATILE) and (HISTORY not in name or name in self.known))
        return {name: found[name] for name in kept}

    def _stamps(self) -> dict[str, tuple[int, int]]:
        found = {}
        for folder, _, names in os.walk(self.work):
            for name in names:
                path = Path(folder) / name
                stat = path.lstat()
                found[str(path.relative_to(self.work))] = (stat.st_size, stat.st_mtime_ns)
        return found


def damage(tree: Tree, file: str, fault: str, random: np.random.Generator) -> str:
    """Do a fault to a file; returns what was done, in words. The time of a file stays: a disk that rots tells none."""
    path = tree.work / file
    content = path.read_bytes()
    stat = path.stat()
    if fault == "delete":
        path.unlink()
        return "deleted"
    if fault == "swap":
        peers = [n for n in tree.known if n != file and _is_peer(n, file) and tree.digests[n] != tree.digests[file]]
        if not peers:
            fault = "flip"
        else:
            other = tree.work / peers[int(random.integers(len(peers)))]
            theirs, there = other.read_bytes(), other.stat()
            path.write_bytes(theirs)
            other.write_bytes(content)
            os.utime(other, ns=(there.st_atime_ns, there.st_mtime_ns + 1))
            os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
            return f"swapped with {other.relative_to(tree.work)}"
    if fault == "truncate":
        length = int(random.integers(len(content))) if content else 0
        path.write_bytes(content[:length])
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
        return f"cut to {length} of {len(content)} bytes"
    if not content:
        path.write_bytes(b"\0")
        return "a byte added"
    # Half of the flips lie within the last kilobyte, where footers and checksums are.
    last = min(len(content), 1024)
    at = int(
        random.integers(len(content) - last, len(content)) if random.random() < 0.5 else random.integers(len(content))
    )
    bit = int(random.integers(8))
    changed = bytearray(content)
    changed[at] ^= 1 << bit
    path.write_bytes(changed)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    return f"bit {bit} of byte {at} of {len(content)} flipped"


def _is_peer(one: str, other: str) -> bool:
    """Return whether two files are of a kind: the same ending, and the same second folder of the same store."""
    kinds = [(Path(n).suffix, Path(n).parts[:5] if "/store/" in n else Path(n).parts[:4]) for n in (one, other)]
    return kinds[0] == kinds[1] and (one.startswith("site/") or Path(one).parent == Path(other).parent)


def commands_on(file: str) -> list[list[str]]:
    """Return the commands that rest on a file, each of which could be the next."""
    survey, inside = SURVEY, file.partition("survey=street/")[2]
    if file.startswith("site/"):
        return [["publish", survey, "--out", "site"]]
    if file.startswith("inventory/"):
        return [
            ["inventory", "status", survey], ["inventory", "pull", survey, "--who", "anna", "--why", "x"],
            ["inventory", "publish", survey], ["inventory", "log", survey],
        ]  # fmt: skip
    found = [["verify", survey]]
    if inside.startswith("manifest/"):
        found += [["status", survey], ["run", survey, "--workers", "0"]]
    elif inside.startswith(("tables/packed_returns", "tables/trajectory", "tables/footprints", "tables/corrections")):
        found += [["reprocess", survey, "--tile", TILE, "--workers", "0"]]
    elif inside.startswith(("tables/", "products/", "tiles/", "report/")):
        found += [["run", survey, "--workers", "0"], ["publish", survey, "--out", "site"]]
    if inside.startswith(("products/assets/", "tables/asset_visibility/")):
        found += [["inventory", "publish", survey]]
    if file.endswith(".parquet") and not inside.startswith("manifest/"):
        found += [["sql", f"SELECT * FROM 'store://survey=street/{inside}'", "--survey", survey, "--csv"]]
    return found


_SLOW: Final = ("run", "reprocess", "status")
"""Commands that take seconds, and are drawn less often."""
TILE: Final = "69100_533500"
"""A tile in the middle of the street."""


def asked(tree: Tree, command: Sequence[str]) -> Answer:
    """Run a command in a process of its own, in the tree."""
    receiving, sending = multiprocessing.get_context("fork").Pipe(duplex=False)
    child = os.fork()
    if child == 0:
        receiving.close()
        signal.alarm(LONGEST_S)
        try:
            sending.send(_run(tree, command))
        finally:
            sending.close()
            os._exit(0)
    sending.close()
    try:
        answer: Answer | None = receiving.recv()
    except EOFError:
        answer = None
    receiving.close()
    _, status = os.waitpid(child, 0)
    if answer is None:
        return Answer(-os.WTERMSIG(status) if os.WIFSIGNALED(status) else -1, "", tree.changed())
    return answer


def _run(tree: Tree, command: Sequence[str]) -> Answer:
    from roadscan.cli import app

    os.chdir(tree.work)
    quiet = io.StringIO()
    with redirect_stdout(quiet), redirect_stderr(quiet):
        result = CliRunner().invoke(app, list(command))
    code, text, failed = result.exit_code, result.output, ""
    if isinstance(result.exception, (RoadscanError, OSError)):
        code, text = 2, f"{text}{result.exception}"
    elif result.exception is not None and not isinstance(result.exception, SystemExit):
        failed = "".join(traceback.format_exception(result.exception))
    return Answer(code, text, tree.changed(), failed)


def judged(tree: Tree, touched: set[str], command: Sequence[str], answer: Answer, clean: Answer) -> tuple[str, str]:
    """Return the state of a trial, and what shows it.

    A command that answers and writes as it does without the fault does not rest on what it left damaged; a site is
    what `publish` writes, so it may leave no damage there.
    """
    if answer.failed:
        return "TRACEBACK", answer.failed.strip().splitlines()[-1]
    if answer.code < 0:
        return "CRASH", f"signal {-answer.code}"
    if answer.code == 2:
        return "refused", _last(answer.text)
    if answer.code != clean.code:
        return "named", _last(answer.text)
    left = {
        name for name in answer.files.keys() | clean.files.keys() if answer.files.get(name) != clean.files.get(name)
    }
    if not touched & left:  # made again: records of that are new
        left = {name for name in left if "/manifest/outputs/" not in name}
    outputs = left if command[0] == "publish" and any(name.startswith("site/") for name in touched) else left - touched
    said, usual = _plain(answer.text), set(_plain(clean.text))
    fresh = [line for line in said if line not in usual]
    told = [line for line in fresh if "damage" in line or any(Path(name).name in line for name in touched)]
    if told:
        return "named", told[0]
    if outputs:
        page = tree.work / "site/layers/tiles/whole.json"
        if page.exists() and '"stale"' in page.read_text():
            return "named", "the page shows the tile as stale"
        return "SILENT", f"differ: {sorted(outputs)[:4]}"
    if said != _plain(clean.text) and command[0] in ("sql", "inventory", "status", "verify"):
        return "SILENT", (fresh or ["fewer lines"])[0]
    return "harmless" if left else "mended", ""


def _plain(text: str) -> list[str]:
    """Return lines without times and progress."""
    drop = (" s", "publish:", "verify:", "site:", "tiles:", "overviews", "report")
    return [line for line in text.splitlines() if not line.rstrip().endswith(drop[0]) and not line.startswith(drop[1:])]


def _last(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1][:300] if lines else ""


def trials(tree: Tree, count: int, seed: int, first: int = 0, only: str = "") -> Iterator[Trial]:
    """Draw faults from a number on and try each: every store in turn, every file of it as likely as another."""
    files = sorted(name for name in tree.known if is_held(name) and only in name)
    stores = [[f for f in files if f.startswith(part)] for part in ("2026-spring/", "inventory/", "site/")]
    stores = [one for one in stores if one]
    _load(tree)
    cleans: dict[str, Answer] = {}
    for number in range(first, first + count):
        random = np.random.default_rng([seed, number])
        store = stores[number % len(stores)]
        file = store[int(random.integers(len(store)))]
        ways = commands_on(file)
        cost = np.array([0.25 if way[0] in _SLOW else 1.0 for way in ways])
        command = ways[int(random.choice(len(ways), p=cost / cost.sum()))]
        fault = FAULTS[int(random.choice(4, p=(0.55, 0.15, 0.15, 0.15)))]
        key = json.dumps(command)
        if key not in cleans:
            cleans[key] = asked(tree, command)
            tree.restore()
        words = damage(tree, file, fault, random)
        touched = set(tree.changed())
        answer = asked(tree, command)
        state, shown = judged(tree, touched, command, answer, cleans[key])
        tree.restore()
        yield Trial(number, file, words, " ".join(w for w in command if w != SURVEY), state, shown)


def _load(tree: Tree) -> None:
    """Run each command once in this process, so that its code is loaded and compiled for all that follow."""
    kinds = ("tables/packed_returns/x.parquet", "manifest/x", "products/x")
    files = ["inventory/x", *(f"2026-spring/store/survey=street/{kind}" for kind in kinds)]
    for command in {json.dumps(one): one for file in files for one in commands_on(file) if one[0] != "sql"}.values():
        answer = _run(tree, command)
        if answer.failed or answer.code:
            raise AssertionError(f"{' '.join(command)} of stores without a fault: {answer.text}{answer.failed}")
        tree.restore()


def is_held(name: str) -> bool:
    """Return whether a file is one of a store: raw logs, survey files and what a person edits are not."""
    return name.startswith(("2026-spring/store/", "inventory/", "site/")) and not name.endswith(VOLATILE)
