"""Kernels compiled for a processor with AVX2 and nothing beyond it: other instructions, the same results."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parents[2]
AVX2 = {
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": (
        "+64bit,+avx,+avx2,+bmi,+bmi2,+cmov,+cx16,+cx8,+f16c,+fma,+fsgsbase,+fxsr,+lzcnt,+mmx,+movbe,+pclmul,+popcnt,"
        "+sahf,+sse,+sse2,+sse3,+sse4.1,+sse4.2,+ssse3,+xsave,+xsaveopt"
    ),
}
"""What a machine of 2013 has."""

REGISTERS = """
import numpy as np
from roadscan.compute.kernels.cell_streaks import sum_up
intensity, sums = np.arange(100, dtype=np.uint8), np.zeros(101, np.uint32)
sum_up(intensity, sums)
assert (sums[1:] == np.cumsum(intensity)).all()
print("zmm" in "".join(sum_up.inspect_asm().values()))
"""


def without_avx512(command: list[str], **more: str) -> str:
    """What a command prints that compiles for such a processor."""
    environment = {**os.environ, **AVX2, **more}
    found = subprocess.run(command, cwd=HERE, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, (found.stdout + found.stderr)[-4000:]
    return found.stdout


def test_a_few_kernels_on_a_plain_processor(tmp_path: Path) -> None:
    """The machine code has no register of 512 bits, and says the same."""
    assert without_avx512([sys.executable, "-c", REGISTERS], NUMBA_CACHE_DIR=str(tmp_path)).strip() == "False"
    places = ["tests/kernels/test_slot_statistics.py", "tests/kernels/test_simd.py"]
    without_avx512([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n0", *places])


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_core_on_a_plain_processor() -> None:
    """Kernels, cells, georeferencing and packing."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n0", "--timeout=1800"]
    places = ["tests/kernels", "tests/tiles", "tests/georeference", "tests/poses/test_trajectory.py"]
    places += ["tests/tiles/test_cell_path.py", "--ignore=tests/kernels/test_uncompiled.py"]
    without_avx512([*command, "--ignore=tests/kernels/test_plain_processor.py", *places])
