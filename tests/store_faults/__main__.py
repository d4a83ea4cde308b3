"""``python -m tests.store_faults FOLDER [--count 1000] [--first 0] [--seed 1] [--only PART]``: faults in stores.

FOLDER holds the stores, or is made: the demo's street, run, an inventory that a person edited, a published site.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.store_faults.base import prepare
from tests.store_faults.trial import Tree, trials


def main() -> int:
    """Run; the exit code is the number of faults that nothing told of."""
    parser = argparse.ArgumentParser(prog="python -m tests.store_faults")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    if not given.folder.exists():
        prepare(given.folder)
    states: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="roadscan-store-faults-") as scratch:
        tree = Tree(given.folder, Path(scratch) / "work")
        for one in trials(tree, given.count, given.seed, given.first, given.only):
            states[one.state] += 1
            sys.stdout.write(f"{one.number:5} {one.state:9} {one.file}: {one.fault}; {one.command}: {one.words}\n")
            sys.stdout.flush()
    sys.stdout.write(", ".join(f"{count} {state}" for state, count in states.most_common()) + "\n")
    return min(sum(count for state, count in states.items() if state.isupper()), 100)


if __name__ == "__main__":
    raise SystemExit(main())
