"""A trial: the demo with one fault, run from its survey file, held against the demo without it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from roadscan.simulate import Scene, simulate
from tests.drawn_faults.compare import Products, differences
from tests.drawn_faults.kinds import KINDS, FaultKind

SURVEY: Final = """
[products]
make = ["tile_table"]

[condition]
"""
ALWAYS: Final = frozenset({("condition_not_measured", "condition")})
"""What a run says of the demo without a fault: its heads are too coarse for cracks and texture. It names no fault."""
RUN_S: Final = 900.0
"""A run that lasts longer has failed."""


@dataclass(frozen=True)
class Said:
    """What a run said of its inputs."""

    code: int
    """Exit code."""
    error: str
    """The line that begins with ``roadscan:``."""
    named: frozenset[tuple[str, str]]
    """What was left out, doubted or failed: kind and subject."""


@dataclass(frozen=True)
class Trial:
    """What came of one fault."""

    number: int
    kind: str
    words: str
    """What was done to the files."""
    named: tuple[str, ...]
    """How the run named it."""
    changed: tuple[str, ...]
    """Figures that differ by more than their σ allows."""
    right: frozenset[str]
    """Witnesses that name this kind of fault for what it is; none: any does."""

    @property
    def is_silent(self) -> bool:
        """True where figures differ and the run says nothing."""
        return bool(self.changed) and not self.named

    @property
    def is_named_otherwise(self) -> bool:
        """True where the run says something, but no witness speaks that would know."""
        return bool(self.named and self.right) and self.right.isdisjoint(line.partition(": ")[0] for line in self.named)

    @property
    def state(self) -> str:
        """In a word."""
        if self.named:
            return "OTHERWISE" if self.is_named_otherwise else "named"
        return "SILENT" if self.is_silent else "harmless"


def prepare(folder: Path) -> Path:
    """The demo's logs with coarser heads (a tenth of the readings), and its run; returns the folder of the survey."""
    survey = folder / "clean"
    scene = Scene.load("demo")
    profilers = scene.profilers.model_copy(update={"spacing_m": 0.05, "readings": 250})
    simulate(scene.model_copy(update={"profilers": profilers}), survey)
    with (survey / "SURVEY.toml").open("a", encoding="utf-8") as file:
        file.write(SURVEY)
    return survey


def trials(
    folder: Path, count: int, seed: int, kinds: tuple[FaultKind, ...] = KINDS, first: int = 0
) -> Iterator[Trial]:
    """Draw faults from a number on and try each: every kind in turn, so that none is left out by chance."""
    survey = prepare(folder)
    said = run(survey)
    clean = Products.read(_store(survey))
    if said.code or said.named - ALWAYS or clean is None:
        raise AssertionError(f"the demo without a fault: exit code {said.code}, {said.error}, {sorted(said.named)}")
    always = {f"{what}: {subject}" for what, subject in ALWAYS}
    order = np.random.default_rng(seed).permutation(len(kinds))
    for number in range(first, first + count):
        one = trial(folder, number, seed, kinds[order[number % len(kinds)]], clean)
        yield replace(one, named=tuple(line for line in one.named if line not in always))


def trial(folder: Path, number: int, seed: int, kind: FaultKind, clean: Products) -> Trial:
    """Put one fault into a copy of the logs, run it, compare."""
    survey = folder / "faulty"
    shutil.rmtree(survey, ignore_errors=True)
    shutil.copytree(folder / "clean", survey, ignore=shutil.ignore_patterns("store"))
    words = kind.draw(np.random.default_rng([seed, number]), survey)
    said = run(survey)
    other = Products.read(_store(survey))
    named = [f"{what}: {subject}" for what, subject in sorted(said.named)]
    if said.code:
        named.insert(0, f"error: {said.error or f'exit code {said.code}'}")
    changed = ["there is no tile"] if other is None else list(differences(clean, other))
    return Trial(number, kind.name, words, tuple(named), tuple(changed), kind.witnesses)


def run(survey: Path) -> Said:
    """`roadscan run` on a survey, in a process of its own."""
    command = [sys.executable, "-m", "roadscan", "run", str(survey / "SURVEY.toml"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=RUN_S, check=False)
    error = next((line for line in done.stderr.splitlines() if line.startswith("roadscan:")), "")
    begin = done.stdout.find("{")
    return Said(done.returncode, error, frozenset(_named(json.loads(done.stdout[begin:]) if begin >= 0 else {})))


def _named(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for one in summary.get("findings", ()):
        yield one["witness"], one["subject"]
    for reason in summary.get("logs", {}).get("reject_reasons", {}):
        yield "rejected", reason
    for one in summary.get("failures", ()):
        yield "failed", one["unit"]


def _store(survey: Path) -> Path:
    return survey / "store" / "survey=demo"
