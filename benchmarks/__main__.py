"""``python -m benchmarks [NAME …]``: run benchmarks and print one table."""

from __future__ import annotations

import importlib
import os
import pkgutil
import platform
import sys
import tempfile
from pathlib import Path

import benchmarks
from benchmarks.timing import Figure


def main() -> None:
    """Run all benchmarks, or those named."""
    names = sys.argv[1:] or [m.name for m in pkgutil.iter_modules(benchmarks.__path__) if m.name.startswith("bench_")]
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}"
    )
    print(f"{'what':58} {'here':>14} {'other':>14} {'ratio':>7}  compared with")
    for name in names:
        module = importlib.import_module(f"benchmarks.{name if name.startswith('bench_') else 'bench_' + name}")
        with tempfile.TemporaryDirectory() as folder:
            for figure in module.figures(Path(folder)):
                show(figure)


def show(f: Figure) -> None:
    """Print one figure."""
    other = f"{f.other:,.4g} {f.unit}" if f.other is not None else ""
    ratio = f"{f.value / f.other:.2f}" if f.other else ""
    print(f"{f.what:58} {f'{f.value:,.4g} {f.unit}':>14} {other:>14} {ratio:>7}  {f.against}", flush=True)


if __name__ == "__main__":
    main()
