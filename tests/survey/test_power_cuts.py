"""Runs that end with a power cut, and runs whose workers are killed: the next ones end with the same files."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from roadscan.store.store import Store
from roadscan.survey.status import verify_store
from tests.conftest import REPOSITORY
from tests.surveys import Simulated, outputs

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(1800)]
CUTS = 12
LONGEST_S = 4.0
"""Processor time within which the power is cut."""
LOST = ("tiles", "products")
"""Folders whose files are not written through to the disk."""


def lose(store: Store, since_s: float, chance: random.Random) -> int:
    """What the disk may hold of files that were written since: nothing, a part, zeros, or all. How many it did not."""
    lost = 0
    for path in [p for top in LOST for p in store.files(top)]:
        file = Path(store.path(path))
        found = file.stat()
        if found.st_mtime < since_s:
            continue
        way = chance.choice(("gone", "cut", "zeros", "whole", "whole"))
        lost += way != "whole"
        if way == "gone":
            file.unlink()
        elif way == "cut":
            os.truncate(file, found.st_size // 2)
        elif way == "zeros":
            file.write_bytes(bytes(found.st_size))
    return lost


def test_power_cuts(finished: Simulated, tmp_path: Path) -> None:
    """As docs/deployment.md says: `roadscan verify` after a power cut, then the next run."""
    copy = finished.copy_to(tmp_path / "survey")
    command = [sys.executable, "-m", "tests.survey.killed_run", "run", str(copy.survey_file), "--workers", "0"]
    chance, lost = random.Random(26), 0
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as runs:
        assert runs.stdin is not None and runs.stdout is not None
        for _ in range(CUTS):
            since_s = time.time()
            print(chance.uniform(1.0, LONGEST_S), file=runs.stdin, flush=True)
            assert runs.stdout.readline().strip() in {"killed", "0"}
            lost += lose(copy.store(), since_s, chance)
            verify_store(copy.store())
        print(1e9, file=runs.stdin, flush=True)
        assert runs.stdout.readline().strip() == "0"
        runs.stdin.close()
    assert lost > CUTS
    assert outputs(copy.store()) == outputs(finished.store())
    assert verify_store(copy.store()) == []


def test_workers_that_are_killed(finished: Simulated, tmp_path: Path) -> None:
    """A worker is killed again and again while a run computes; the run goes on, or names what it lost."""
    copy = finished.copy_to(tmp_path / "survey")
    command = [sys.executable, "-m", "roadscan", "run", str(copy.survey_file), "--workers", "2"]
    chance, killed = random.Random(26), 0
    for _ in range(3):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, cwd=REPOSITORY) as run:
            assert run.stderr is not None
            while run.poll() is None:
                time.sleep(chance.uniform(0.5, 2.0))
                killed += _kill_a_worker(run.pid, chance)
            said = run.stderr.read().decode()
        assert run.returncode in {0, 2} and "Traceback" not in said, said
        copy.store().remove("manifest/outputs")
    assert killed > 3
    copy.run()
    assert outputs(copy.store()) == outputs(finished.store())
    assert verify_store(copy.store()) == []


def _kill_a_worker(run: int, chance: random.Random) -> bool:
    """Whether there was one."""
    try:
        alive = [p for p in psutil.Process(run).children() if "spawn_main" in " ".join(p.cmdline())]
        if alive:
            chance.choice(alive).send_signal(signal.SIGKILL)
    except psutil.NoSuchProcess:
        return False
    return bool(alive)
