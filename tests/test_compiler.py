"""How loops are compiled: Numba's own counts of what had to be, on empty caches.

Of two processes one meets the simulator first: both have to compile for the same processor.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import sys
import numpy as np
from roadscan.kernels.poses import slope_weights
print("ready", flush=True)
sys.stdin.readline()
times, weights = np.array([0.0, 1.0, 2.0]), np.zeros(3)
slope_weights(times, 1.0, weights)
print(sum(slope_weights.stats.cache_misses.values()), weights @ times**2)
"""


def test_one_process_compiles_and_the_others_load(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c"]
    processes = [
        subprocess.Popen(
            [*command, before + SCRIPT], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for before in ("", "import roadscan.simulate")
    ]
    for process in processes:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    said = sorted(process.communicate()[0].strip() for process in processes)
    assert said == ["0 2.0", "1 2.0"]  # the square's slope at 1, computed by both


PARTS = """
from roadscan.kernels.options import inlined, kernel

@inlined
def one_more(count):
    return count + 1

@kernel
def up_to(n):
    count = 0
    while count < n:
        count = one_more(count)
    return one_more(0) + count

print(up_to(3), len(one_more.overloads))
try:
    one_more(3)
except TypeError as error:
    print(error)
"""


def test_a_written_number_makes_no_second_variant_and_a_part_is_not_called_from_python(tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, str(tmp_path / "parts.py")]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert said.startswith("4 1\none_more is compiled into its callers only")
