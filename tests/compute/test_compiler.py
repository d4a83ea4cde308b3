"""How loops are compiled: Numba's own counts of what had to be, on empty caches.

Of two processes one meets the simulator first: both have to compile for the same processor.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import sys
import numpy as np
from roadscan.poses.kernels.poses import slope_weights
print("ready", flush=True)
sys.stdin.readline()
times, weights = np.array([0.0, 1.0, 2.0]), np.zeros(3)
slope_weights(times, 1.0, weights)
print(sum(slope_weights.stats.cache_misses.values()), weights @ times**2)
"""


@pytest.mark.slow
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
from numba.core.codegen import JITCPUCodegen

from roadscan.compute.kernel_options import inlined, kernel

given, add = [], JITCPUCodegen._add_module
JITCPUCodegen._add_module = lambda codegen, module: given.append(module.name) or add(codegen, module)

@inlined
def one_more(count):
    return count + 1

@kernel
def up_to(n):
    count = 0
    while count < n:
        count = max(one_more(count), 0)
    return one_more(0) + count

print(up_to(3), len(one_more.overloads), given)
try:
    one_more(3)
except TypeError as error:
    print(error)
"""


def test_a_written_number_makes_no_second_variant_and_a_part_is_not_called_from_python(tmp_path: Path) -> None:
    """Machine code is made of the kernel alone: neither of its part nor of what Numba has in place of `max`."""
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, str(tmp_path / "parts.py")]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert said.startswith("4 1 ['nrt', 'up_to']\none_more is compiled for its callers only")


HANDED_BACK = """
import numpy as np
from roadscan.compute.kernel_options import bare, kernel

@bare
def part(values):
    return 1, values[1:]

@kernel
def total(values):
    return part(values)[1].sum()

try:
    total(np.ones(3))
except Exception as error:
    print(type(error).__name__, error)
"""


def test_a_kernel_that_counts_no_references_cannot_hand_an_array_back(tmp_path: Path) -> None:
    """Its callers would give a reference back that was never counted, and free memory that is still in use."""
    (tmp_path / "handed.py").write_text(HANDED_BACK, encoding="utf-8")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, str(tmp_path / "handed.py")]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=False).stdout
    assert "part counts no references and hands an array back" in said


VARIANTS = """
import sys
import numpy as np
from roadscan.compute.kernel_options import kernel

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


@pytest.mark.slow
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


TOLD = """
import time
from roadscan.run import progress, session
progress._LOOK_S = 0.05

class Lines(session.Reporter):
    def line(self, text):
        print(text, flush=True)

with progress.reporting_compilation(Lines()):
    import parts
    time.sleep(0.5)
"""


@pytest.mark.slow
def test_a_run_tells_what_is_compiled(tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text(PARTS, encoding="utf-8")
    (tmp_path / "told.py").write_text(TOLD, encoding="utf-8")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, str(tmp_path / "told.py")]

    def told() -> list[str]:
        said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        return [line for line in said.splitlines() if line.startswith("compiled")]

    assert told()[-1] == "compiled, once for this machine: 2 kernels, the last is parts.up_to"
    assert told() == []


ROOT = Path(__file__).resolve().parents[2]
FOLDERS = """
from pathlib import Path
from roadscan.compute.kernel_options import _folder_of_source
kernels = Path("roadscan/feature/kernels").resolve()
for file in sorted(kernels.rglob("*.py")):
    print(file.relative_to(kernels), _folder_of_source(str(file)))
"""
CORE = ("__init__.py", "kept.py", "private_folder.py")
COMPUTE = ("__init__.py", "compiler.py", "kernel_options.py", "numba_internals.py")
CHAIN = {
    "rooms/first.py": "from roadscan.feature.kernels.rooms import second\n",
    "rooms/second.py": "from .deep.third import doubled\n",
    "rooms/deep/third.py": "def f():\n    import roadscan.feature.kernels.fourth\n",
    "fourth.py": "from . import fifth as other\n",
    "fifth.py": "FACTOR = 2\n",
    "rooms/alone.py": "from roadscan.compute.kernel_options import kernel\n",
}


@pytest.mark.slow
@pytest.mark.parametrize("changed", CHAIN)
def test_a_changed_kernel_changes_the_folder_of_all_that_import_it(tmp_path: Path, changed: str) -> None:
    """Whatever the form of the import and the depth of the folder; no other kernel is compiled again."""
    for name in (
        "__init__.py",
        "core/__init__.py",
        "core/private_folder.py",
        "core/private_folder.py",
        *(f"compute/{n}" for n in COMPUTE),
    ):
        (tmp_path / "roadscan" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "roadscan" / name, tmp_path / "roadscan" / name)
    kernels = tmp_path / "roadscan/feature/kernels"
    for name, text in CHAIN.items():
        (kernels / name).parent.mkdir(parents=True, exist_ok=True)
        (kernels / name).write_text(text, encoding="utf-8")
        (kernels / name).with_name("__init__.py").touch()

    def folders() -> dict[str, str]:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        command = [sys.executable, "-c", FOLDERS]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        return dict(line.split() for line in done.stdout.splitlines())

    before = folders()
    (kernels / changed).write_text(CHAIN[changed] + "# changed\n", encoding="utf-8")
    after = folders()
    chain = [name for name in CHAIN if name != "rooms/alone.py"]
    stale = {changed} if changed == "rooms/alone.py" else set(chain[: chain.index(changed) + 1])
    assert {name for name in before if before[name] != after[name]} == stale


UNKNOWN_NUMBA = """
import sys
import numba
numba.__version__ = "1000.0"
import pytest
from roadscan.compute.numba_internals import KNOWN
assert not KNOWN
sys.exit(pytest.main(["-q", "-n", "0", "-p", "no:cacheprovider", *sys.argv[1:]]))
"""


@pytest.mark.parametrize(
    "tests",
    ["kernels/test_simd.py::test_streaks_are_runs_of_equal_cells", pytest.param("kernels", marks=pytest.mark.nightly)],
)
def test_kernels_pass_their_tests_on_a_numba_whose_internals_are_not_known(tests: str, tmp_path: Path) -> None:
    """Nothing of Numba is changed then; an empty cache, so that all is compiled that way."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", UNKNOWN_NUMBA, str(Path(__file__).parents[1] / tests)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
