"""``python -m tests.drawn_faults [--count 50] [--seed 1] [--kind NAME]``: faults drawn into the demo's logs.

Prints what each fault was, how the run named it, which figures it changed beyond their σ, and the share of silent ones.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from tests.drawn_faults.kinds import KINDS
from tests.drawn_faults.trial import Trial, trials


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def show(found: Iterable[Trial]) -> list[Trial]:
    """Print each trial as it ends, then the share of silent ones; returns them all."""
    kept: list[Trial] = []
    for one in found:
        kept.append(one)
        state = "SILENT" if one.is_silent else "named" if one.named else "harmless"
        say(f"{one.number:3} {state:9}{one.kind}: {one.words}")
        for line in one.named[:3]:
            say(f"      named    {line[:200]}")
        for line in one.changed[:3]:
            say(f"      changed  {line}")
    silent = [one for one in kept if one.is_silent]
    say(f"silent: {len(silent)} of {len(kept)} ({len(silent) / max(len(kept), 1):.0%})")
    return kept


def main() -> int:
    """Run; the exit code is the number of silent faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.drawn_faults")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", action="append", choices=[kind.name for kind in KINDS])
    given = parser.parse_args()
    kinds = tuple(kind for kind in KINDS if not given.kind or kind.name in given.kind)
    with tempfile.TemporaryDirectory(prefix="roadscan-faults-") as folder:
        found = show(trials(Path(folder), given.count, given.seed, kinds))
    return min(sum(one.is_silent for one in found), 100)


if __name__ == "__main__":
    raise SystemExit(main())
