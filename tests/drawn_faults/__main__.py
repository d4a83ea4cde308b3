"""``python -m tests.drawn_faults [--count 50] [--first 0] [--seed 1] [--kind NAME]``: faults in the logs of the demo.

Prints what each fault was, how the run named it, which figures it changed beyond their σ, and the shares of silent ones
and of those that are named otherwise: something else was blamed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from tests.drawn_faults.kinds import KINDS
from tests.drawn_faults.trial import Trial, trials

_LINES = 6
"""Lines that are printed of what was named, and of what changed."""


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def show(found: Iterable[Trial]) -> list[Trial]:
    """Print each trial as it ends, then the share of silent ones; returns them all."""
    kept: list[Trial] = []
    for one in found:
        kept.append(one)
        say(f"{one.number:3} {one.state:10}{one.kind}: {one.words}")
        for line in one.named[:_LINES]:
            say(f"      named    {line[:200]}")
        for line in one.changed[:_LINES]:
            say(f"      changed  {line}")
    for word, count in (
        ("silent", sum(one.is_silent for one in kept)), ("named otherwise", sum(one.is_named_otherwise for one in kept))
    ):  # fmt: skip
        say(f"{word}: {count} of {len(kept)} ({count / max(len(kept), 1):.0%})")
    return kept


def main() -> int:
    """Run; the exit code is the number of silent faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.drawn_faults")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", action="append", choices=[kind.name for kind in KINDS])
    given = parser.parse_args()
    kinds = tuple(kind for kind in KINDS if not given.kind or kind.name in given.kind)
    with tempfile.TemporaryDirectory(prefix="roadscan-faults-") as folder:
        found = show(trials(Path(folder), given.count, given.seed, kinds, given.first))
    return min(sum(one.is_silent for one in found), 100)


if __name__ == "__main__":
    raise SystemExit(main())
