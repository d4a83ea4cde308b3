"""Two processes on one empty cache: Numba's own count of what each had to compile.

One of them meets the simulator first: both have to compile for the same processor.
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
