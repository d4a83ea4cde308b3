"""Runs of a survey in fresh processes, each with a fresh store; their peak memory is watched from outside."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from benchmarks.surveys import BenchSurvey
from roadscan.compute.kernels.vectors import compiles_for
from tests.kernels.test_plain_processor import AVX2

_EVERY_S = 0.05
_GROUPS = Path("/sys/fs/cgroup/cpu")
_WORKER_MARK = "multiprocessing.spawn"
"""In the command line of Dask's workers."""


@dataclass(frozen=True)
class Way:
    """How a survey is run."""

    processor: str = ""
    """Class of processor that kernels are compiled for; the machine's own where it is empty."""
    products: tuple[str, ...] = ()
    """What :mod:`benchmarks.pipeline` is asked for."""
    share: float = 0.0
    """Share of a core that each worker may use; all that there is where it is 0."""

    @property
    def environment(self) -> dict[str, str]:
        """What a process of this way is started with."""
        return {**os.environ, **(AVX2 if self.processor == "AVX2" else {})}


def processors() -> list[str]:
    """Classes of processor that this machine can be tried as."""
    return ["AVX-512", "AVX2"] if compiles_for("avx512f") else ["AVX2"]


@dataclass(frozen=True)
class Runs:
    """Several runs of one survey with the same number of workers."""

    survey: BenchSurvey
    workers: int
    way: Way = field(default_factory=Way)
    figures: list[dict[str, Any]] = field(default_factory=list)
    """One run each, as :mod:`benchmarks.pipeline` prints it, with `main_mb` and `worker_mb`."""

    def wall_s(self, *stages: str) -> float:
        """Median over the runs of the wall time of these stages together."""
        return self._stages("wall_s", stages)

    def cpu_s(self, *stages: str) -> float:
        """Median over the runs of the processor time of these stages together, all processes."""
        return self._stages("cpu_s", stages)

    @property
    def stages(self) -> list[str]:
        """The stages of a run, in their order."""
        return list(self.figures[0]["stages"])

    def real_time(self, *stages: str, by_processor: bool = False) -> float:
        """How often the time that was recorded holds that of these stages.

        `by_processor` : of their processor time on all workers' cores, which no other work on the machine lengthens.
        """
        seconds = self.cpu_s(*stages) / self.workers if by_processor else self.wall_s(*stages)
        return self.survey.recorded_s / seconds

    def tasks(self, *stages: str) -> float:
        """Tasks handed to workers."""
        return self._stages("tasks", stages)

    def figure(self, name: str) -> float:
        """Median over the runs of a figure of the whole run."""
        return float(median(f[name] for f in self.figures))

    def _stages(self, what: str, stages: tuple[str, ...]) -> float:
        return float(median(sum(f["stages"][s][what] for s in stages) for f in self.figures))


def measured_runs(survey: BenchSurvey, folder: Path, workers: int = 2, repeats: int = 5) -> Runs:
    """Run a survey `repeats` times; stores are made below `folder` and removed."""
    return measured_in_turns(survey, folder, [Way()], workers, repeats)[0]


def measured_in_turns(
    survey: BenchSurvey, folder: Path, ways: Sequence[Way], workers: int = 2, repeats: int = 5
) -> list[Runs]:
    """Run a survey `repeats` times each way; the ways take turns, so that one clock of the machine holds for all."""
    found = [Runs(survey, workers, way) for way in ways]
    for _ in range(repeats):
        for runs in found:
            store = folder / "store"
            shutil.rmtree(store, ignore_errors=True)
            try:
                runs.figures.append(_one_run(survey, store, workers, runs.way))
            finally:
                shutil.rmtree(store, ignore_errors=True)
    return found


def _one_run(survey: BenchSurvey, store: Path, workers: int, way: Way) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.pipeline", str(survey.file), str(store), str(workers), *way.products]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=way.environment) as process:
        watch = _Watch(process.pid, way.share)
        watch.start()
        out, _ = process.communicate()
        watch.stop()
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}")
    main_mb, worker_mb = watch.peaks_mb()
    return json.loads(out.splitlines()[-1]) | {"main_mb": main_mb, "worker_mb": worker_mb}


class _Watch(threading.Thread):
    """Looks at a process and its children until it is stopped, and keeps the largest resident memory of each."""

    def __init__(self, pid: int, share: float) -> None:
        super().__init__(daemon=True)
        self._pid = pid
        self._share = share
        self._over = threading.Event()
        self._peak_bytes: dict[int, int] = {}
        self._workers: set[int] = set()

    def run(self) -> None:
        """Sample."""
        try:
            top = psutil.Process(self._pid)
            while not self._over.wait(_EVERY_S):
                self._look(top)
                for child in top.children(recursive=True):
                    self._look(child)
        except psutil.NoSuchProcess:
            return

    def stop(self) -> None:
        """End it."""
        self._over.set()
        self.join()
        if self._share:
            _remove_groups()

    def peaks_mb(self) -> tuple[float, float]:
        """Peak of the first process, and of the worker that took most (MiB; of the first where there is none)."""
        first = self._peak_bytes.get(self._pid, 0)
        return first / 2**20, max((self._peak_bytes[p] for p in self._workers), default=first) / 2**20

    def _look(self, process: psutil.Process) -> None:
        try:
            self._peak_bytes[process.pid] = max(self._peak_bytes.get(process.pid, 0), _peak_rss(process))
            if process.pid != self._pid and _WORKER_MARK in " ".join(process.cmdline()):
                if self._share and process.pid not in self._workers:
                    _limit(process.pid, self._share)
                self._workers.add(process.pid)
        except (psutil.NoSuchProcess, psutil.ZombieProcess, psutil.AccessDenied):
            return


def _limit(pid: int, share: float) -> None:
    """Give a process this share of a core, by a control group (version 1)."""
    group = _GROUPS / f"roadscan-bench-{pid}"
    group.mkdir()
    period_us = int((group / "cpu.cfs_period_us").read_text())
    (group / "cpu.cfs_quota_us").write_text(f"{round(share * period_us)}")
    with contextlib.suppress(ProcessLookupError):  # it has just ended
        (group / "cgroup.procs").write_text(f"{pid}")


def _remove_groups() -> None:
    """Remove the groups of processes that have ended."""
    for group in _GROUPS.glob("roadscan-bench-*"):
        with contextlib.suppress(OSError):  # its process is at work
            group.rmdir()


def _peak_rss(process: psutil.Process) -> int:
    """High-water mark of resident memory (bytes) where the system keeps one, else what is resident now."""
    try:
        for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return int(process.memory_info().rss)
