"""``python -m benchmarks [--json FILE] [--set SETTING=VALUE …] [NAME …]``: run benchmarks and print one table.

The figures go to ``benchmarks/results/<name>.json`` as well, or to FILE. Settings: :mod:`benchmarks.settings`.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime as dt
import importlib
import json
import os
import pkgutil
import platform
import tempfile
from pathlib import Path

import benchmarks
from benchmarks.settings import VARIABLE
from benchmarks.timing import Figure

RESULTS = Path(__file__).parent / "results"


def main() -> None:
    """Run all benchmarks, or those named."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Run benchmarks and print one table.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="all where none is named")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SETTING=VALUE", help="see benchmarks/settings.py"
    )
    asked = parser.parse_args()
    os.environ[VARIABLE] = " ".join([os.environ.get(VARIABLE, ""), *asked.set]).strip()
    names = asked.names or [m.name for m in pkgutil.iter_modules(benchmarks.__path__) if m.name.startswith("bench_")]
    machine = (
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}"
    )
    print(machine)
    print(f"{'what':58} {'here':>14} {'other':>14} {'ratio':>7}  compared with")
    results: dict[str, list[Figure]] = {}
    for name in names:
        module = importlib.import_module(f"benchmarks.{name if name.startswith('bench_') else 'bench_' + name}")
        shown = results.setdefault(name.removeprefix("bench_"), [])
        with tempfile.TemporaryDirectory() as folder:
            for figure in module.figures(Path(folder)):
                show(figure)
                shown.append(figure)
                write(results, machine, asked.json)


def show(f: Figure) -> None:
    """Print one figure."""
    other = f"{f.other:,.4g} {f.unit}" if f.other is not None else ""
    ratio = f"{f.value / f.other:.2f}" if f.other else ""
    print(f"{f.what:58} {f'{f.value:,.4g} {f.unit}':>14} {other:>14} {ratio:>7}  {f.against}", flush=True)


def write(results: dict[str, list[Figure]], machine: str, file: Path | None) -> None:
    """Write what there is so far: the figures of the last benchmark to its own file, or all to `file`."""
    name, figures = list(results.items())[-1]
    said = {"machine": machine, "date": dt.datetime.now(dt.UTC).isoformat(timespec="seconds")}
    said["settings"] = os.environ[VARIABLE]
    one = {name: figures} if file is None else results
    figures_of = {n: [dataclasses.asdict(f) for f in found] for n, found in one.items()}
    target = file or RESULTS / f"{name}.json"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(json.dumps({**said, "figures": figures_of}, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
