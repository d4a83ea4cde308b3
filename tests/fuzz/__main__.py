"""``python -m tests.fuzz [--mutants 10000] [--format NAME] [--seed N]``: damaged files of every format.

Each sample's files are read in a process of their own, which a reader may crash or hang without ending the run. The
table says, per format: files, how many were refused, read with rejects, read clean; the slowest (ms), the highest
memory beyond the process's own (MB), files that lost rows without a word though no byte is missing, and failures.
A failure is repeated with ``--format NAME/FORM --seed N --only NUMBER``.
"""

from __future__ import annotations

import argparse
import json
import os
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from roadscan.ingest.reading.format import log_formats
from tests.fuzz.harness import SLOWEST_S, Fuzzer, Outcome, Summary
from tests.fuzz.samples import Sample, all_samples

START_S = 120.0
SLOW_MS = 500.0
"""A slower file is named."""


def main() -> int:
    """Run; the exit code is the number of formats with failures."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz")
    parser.add_argument("--mutants", type=int, default=10_000, help="damaged files a format")
    parser.add_argument("--native", type=int, help="the same for forms that are read through a process of their own")
    parser.add_argument("--format", action="append", help="format, or format/form (all where left out)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="this file alone, in this process, with all it says")
    parser.add_argument("--show", type=int, default=3, help="failures shown a format")
    given = parser.parse_args()
    wanted = given.format or list(log_formats())
    say(
        f"{'format':18}{'files':>8}{'refused':>9}{'rejects':>9}{'clean':>8}{'slowest':>9}{'MB':>7}{'fewer':>7}{'failed':>8}{'s':>7}"
    )
    failed = 0
    for name in wanted:
        samples = [s for s in all_samples() if name in {s.format, s.name}]
        if given.only is not None:
            repeat(samples[0], given.seed, given.only)
            continue
        started = time.monotonic()
        summary = Summary()
        for sample, count in shares(samples, given.mutants, given.native):
            for outcome in outcomes(sample, given.seed, count):
                summary.add(outcome)
        show(name, summary, time.monotonic() - started, given.show, given.seed)
        failed += bool(summary.failures)
    return min(failed, 100)


def say(*parts: object) -> None:
    sys.stdout.write("".join(map(str, parts)) + "\n")
    sys.stdout.flush()


def shares(samples: list[Sample], mutants: int, native: int | None) -> Iterator[tuple[Sample, int]]:
    """How many files of each form make up `mutants` of the format."""
    whole = sum(s.share for s in samples)
    for sample in samples:
        count = -(-mutants * sample.share // whole)
        yield sample, int(count if native is None or not sample.native else min(count, native))


def show(name: str, s: Summary, seconds: float, most: int, seed: int) -> None:
    v = s.verdicts
    slowest_ms = 0.0 if s.slowest is None else s.slowest.ms
    say(
        f"{name:18}{s.outcomes:8}{v['refused']:9}{v['rejects']:9}{v['clean']:8}{slowest_ms:9.0f}{s.peak_mb:7.0f}"
        f"{len(s.fewer):7}{len(s.failures):8}{seconds:7.0f}",
        *(f" {other}:{count}" for other, count in s.claimed.items()),
    )
    if s.slowest is not None and s.slowest.ms > SLOW_MS:
        say(f"  slowest: {s.slowest.form} {s.slowest.number}")
    for outcome in s.failures[:most]:
        form = f"{name.split('/', 1)[0]}/{outcome.form}"
        say(f"  failed: --format {form} --seed {seed} --only {outcome.number}\n{outcome.said}")
    if s.fewer:
        told = ", ".join(f"{o.form} {o.number}" for o in s.fewer[:8])
        say(f"  fewer rows without a word: {told}")


def outcomes(sample: Sample, seed: int, count: int) -> Iterator[Outcome]:
    """Outcomes of files 0 … count − 1; a process that ends or hangs costs one of them."""
    done = 0
    while done < count:
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            for outcome in _of_process(sample, seed, done, count, folder):
                yield outcome
                done = outcome.number + 1


def _of_process(sample: Sample, seed: int, first: int, end: int, folder: str) -> Iterator[Outcome]:
    command = [sys.executable, "-m", "tests.fuzz.worker", sample.name, str(seed), str(first), str(end), folder]
    number = first
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            lines = _lines(process, START_S)
            ready = any(line == "ready\n" for line in lines)
            for line in lines:
                yield Outcome(**_typed(json.loads(line)))
                number += 1
            if number < end:
                process.kill()
                said = process.stderr.read()
                if not ready:
                    raise RuntimeError(f"{sample.name}: the sound file cannot be read\n{said}")
                yield Outcome(
                    number, sample.form, "failed", 0.0, 0.0, said=f"the process ended or hung\n{said[-3000:]}"
                )
        finally:
            process.kill()


def _lines(process: subprocess.Popen[str], start_s: float) -> Iterator[str]:
    """Lines as they come, until the process ends or says nothing for too long."""
    assert process.stdout is not None
    patience = start_s
    rest = b""
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while selector.select(patience) and (part := os.read(process.stdout.fileno(), 1 << 16)):
            *lines, rest = (rest + part).split(b"\n")
            for line in lines:
                yield line.decode() + "\n"
                patience = 3 * SLOWEST_S


def _typed(values: dict[str, Any]) -> dict[str, Any]:
    return values | {"claimed_by": tuple(values["claimed_by"])}


def repeat(sample: Sample, seed: int, number: int) -> None:
    """One file again; its bytes are left in `fuzzed`."""
    with tempfile.TemporaryDirectory() as folder:
        fuzzer = Fuzzer(sample, Path(folder), seed)
        target, data = fuzzer.damaged(number)
        kept = Path("fuzzed") / target
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(data)
        say(f"{kept}: {len(data)} bytes\n{fuzzer.run(number)}\nsound: {fuzzer.sound.rows} rows")


if __name__ == "__main__":
    sys.exit(main())
