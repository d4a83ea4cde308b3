"""Every format with other damaged files each night; ``make fuzz`` reads 10,000 a format."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from roadscan.ingest.reading.format import log_formats
from tests.conftest import REPOSITORY

A_NIGHT = 400
NATIVE = 20
"""Of forms that are read through a process of their own."""
SEED = int(time.time()) // 86_400
"""The day: a failure's line names it, so that it can be repeated."""


@pytest.mark.nightly
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", log_formats())
def test_damaged_files(name: str) -> None:
    command = [sys.executable, "-m", "tests.fuzz", "--mutants", str(A_NIGHT), "--native", str(NATIVE)]
    done = subprocess.run(
        [*command, "--format", name, "--seed", str(SEED)], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]
