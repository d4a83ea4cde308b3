"""``python -m tests.house [--lower]``: measures the library against the limits in ``limits.toml``.

Ends with 1 where a figure is above its limit. ``--lower`` writes the limits that have fallen; to raise one, edit the
file, in a commit that says what for.
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from pathlib import Path

from tests.house.figures import figures

LIMITS = Path(__file__).with_name("limits.toml")


def main() -> int:
    """Print each figure with its limit."""
    parser = argparse.ArgumentParser(prog="python -m tests.house")
    parser.add_argument("--lower", action="store_true")
    lower = parser.parse_args().lower
    limits: dict[str, int] = tomllib.loads(LIMITS.read_text())
    found = figures()
    for name, value in found.items():
        state = "NO LIMIT" if name not in limits else "ABOVE" if value > limits[name] else ""
        sys.stdout.write(f"{name:44}{value:9,} of {limits.get(name, 0):9,}  {state}\n")
    if lower:
        kept = {name: min(value, limits.get(name, value)) for name, value in found.items()}
        LIMITS.write_text("".join(f'"{name}" = {value}\n' for name, value in kept.items()))
        return 0
    return int(any(value > limits.get(name, -1) for name, value in found.items()))


if __name__ == "__main__":
    raise SystemExit(main())
