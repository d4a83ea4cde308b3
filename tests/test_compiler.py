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


VARIANTS = """
import sys
import numpy as np
from roadscan.kernels.options import kernel

def times(factor):
    @kernel
    def multiplied(values):
        total = 0.0
        for value in values:
            total += factor * value
        return total
    return multiplied

twice, thrice = times(2.0), times(3.0)

@kernel
def with_twice(values):
    return twice(values)

@kernel
def with_thrice(values):
    return thrice(values)

values = np.ones(4)
print(*(globals()[name](values) for name in sys.argv[1:]))
print(*(own.fndesc.mangled_name for variant in (twice, thrice) for own in variant.overloads.values()))
"""


def test_variants_of_one_name_that_two_processes_compile_have_names_of_their_own(tmp_path: Path) -> None:
    """The linker takes the first of two functions of one name: a third process would call it for the other."""
    script = tmp_path / "variants.py"
    script.write_text(VARIANTS, encoding="utf-8")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def said(*names: str) -> list[str]:
        command = [sys.executable, str(script), *names]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    first, second = said("with_twice"), said("with_thrice")
    assert [first[0], second[0], said("with_twice", "with_thrice")[0]] == ["8.0", "12.0", "8.0 12.0"]
    assert first[1] and second[1] and first[1] != second[1]
