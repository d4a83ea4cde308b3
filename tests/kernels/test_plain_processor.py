"""Kernels compiled for a processor with AVX2 and nothing beyond it: other instructions, the same results."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import roadscan

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
from roadscan.compute.kernels.streaks import sum_up
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


@pytest.mark.slow
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


LAST_BITS = """
import hashlib
import numpy as np
import scipy.linalg
rng = np.random.default_rng(1)
x, a = np.abs(rng.normal(size=10_001)) + 0.01, rng.normal(size=(3000, 511))
solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(a.T @ a), x[:511])
parts = [np.exp(-x), np.log(x), np.tan(x), np.arctan(x), x**1.3, solved, np.linalg.inv(a.T @ a)]
print(hashlib.md5(b"".join(p.tobytes() for p in parts)).hexdigest())
"""


def test_libraries_compute_the_same_last_bits_on_a_plain_processor() -> None:
    """NumPy, SciPy and OpenBLAS, whichever instructions and cores there are."""
    plain = {
        "NPY_DISABLE_CPU_FEATURES": "X86_V4", "OPENBLAS_CORETYPE": "Haswell", "OPENBLAS_NUM_THREADS": "1",
        "ARROW_USER_SIMD_LEVEL": "AVX2", "OPENCV_CPU_DISABLE": "AVX512-SKX",
    }  # fmt: skip
    bare = {name: value for name, value in os.environ.items() if name not in plain}
    found = {}
    with_roadscan = f"import roadscan\n{LAST_BITS}"
    runs = (("plain", bare | plain, LAST_BITS), ("roadscan", bare, with_roadscan), ("bare", bare, LAST_BITS))
    for name, environment, code in runs:
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=HERE, env=environment, capture_output=True, text=True, check=True
        )
        found[name] = done.stdout.strip()
    assert found["roadscan"] == found["plain"]
    if "avx512f" in Path("/proc/cpuinfo").read_text():
        assert found["bare"] != found["plain"]  # otherwise the settings would not be needed


@pytest.mark.parametrize("file", ["deploy/Containerfile", "deploy/systemd/roadscan.env", "deploy/slurm/cluster.py"])
def test_services_begin_with_what_roadscan_sets(file: str) -> None:
    """Dask's own workers import NumPy before roadscan: their environment has to hold it."""
    text = (HERE / file).read_text()
    for name, value in (roadscan._SUMS | roadscan._WIDE).items():
        assert f"{name}={value}" in text
