"""``python -m tests.house [--lower | --raise NAME "what for"]``: measures the library against ``limits.toml``.

Ends with 1 where a figure is above its limit or a limit rose without a reason.
"""

from __future__ import annotations

import argparse
import sys

from tests.house import limits
from tests.house.figures import figures


def main() -> int:
    """Print each figure with its limit, and what is wrong; return 1 where something is."""
    parser = argparse.ArgumentParser(prog="python -m tests.house")
    change = parser.add_mutually_exclusive_group()
    change.add_argument("--lower", action="store_true", help="write the limits that have fallen; none rises")
    change.add_argument(
        "--raise",
        dest="risen",
        nargs=2,
        metavar=("NAME", "WHAT_FOR"),
        help="raise the limits that are exceeded and match a name or pattern ('lines*', '*'), with the reason",
    )
    chosen = parser.parse_args()
    found, known = figures(), limits.read()
    if chosen.risen:
        known = limits.raised(found, known, *chosen.risen)
    if chosen.lower:
        known = limits.lowered(found, known)
    if chosen.risen or chosen.lower:
        limits.write(known)
    for name, value in found.items():
        limit = known.get(name)
        state = "NO LIMIT" if limit is None else "ABOVE" if value > limit.most else ""
        sys.stdout.write(f"{name:44}{value:9,} of {limit.most if limit else 0:9,}  {state}\n")
    wrong = limits.exceeded(found, known) + limits.unexplained(known, limits.earlier())
    sys.stdout.writelines(f"{line}\n" for line in wrong)
    return int(bool(wrong))


if __name__ == "__main__":
    raise SystemExit(main())
