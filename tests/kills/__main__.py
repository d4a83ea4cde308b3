"""``python -m tests.kills FOLDER [--place s3] [--count 100] [--first 0] [--seed 1] [--only STEP]``: killed commands.

FOLDER holds the states in which commands are called, or is made. Each draw is told by its seed and number; a campaign
goes on with `--first`. The states belong to one version of the code: a folder of another one has to go first.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

from tests.kills.states import Place
from tests.kills.steps import Base, guest, prepare
from tests.kills.trial import draws
from tests.object_store import served


def main() -> int:
    """Run; the exit code is the number of draws with a fault."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--place", choices=("folder", "s3"), default="folder")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    kills: Counter[str] = Counter()
    bad = 0
    with ExitStack() as stack:
        if given.place == "s3":
            stack.enter_context(served())
        own = given.folder.resolve() / given.place
        place = Place(own / "work", own / "pool", given.place == "s3")
        runs = stack.enter_context(guest(place.work, own / "said.log"))
        if (file := own / "base.json").exists():
            base = Base.load(file)
        else:
            base = prepare(place, runs, lambda text: sys.stderr.write(f"{text}\n"))
            base.save(file)
        numbers = range(given.first, given.first + given.count)
        for draw in draws(place, base, runs, given.seed, numbers, given.only):
            kills[draw.step] += len(draw.kills)
            bad += bool(draw.faults)
            sys.stdout.write(f"{draw.line()}\n")
            sys.stdout.flush()
    told = ", ".join(f"{count} {step}" for step, count in kills.most_common())
    sys.stdout.write(f"{kills.total()} kills in {given.count} draws, {bad} with a fault: {told}\n")
    return min(bad, 100)


if __name__ == "__main__":
    raise SystemExit(main())
