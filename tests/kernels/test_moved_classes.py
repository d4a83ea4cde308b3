"""A cache of compiled kernels outlives the classes of their arguments, which move from module to module."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

KERNEL = """
from roadscan.compute.kernel_options import kernel

@kernel
def total(pair):
    return pair.first + pair.second
"""
PAIR = "from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    first: int\n    second: int\n"


@pytest.mark.slow
def test_a_class_that_moved_is_compiled_for_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba's index of a function's cache holds the classes of arguments by module and name."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "totals.py").write_text(KERNEL, encoding="utf-8")
    for before, now in (("elsewhere", "here"), ("here", "elsewhere")):
        (tmp_path / f"{before}.py").unlink(missing_ok=True)
        (tmp_path / f"{now}.py").write_text(PAIR, encoding="utf-8")
        program = f"import totals, {now}; print(totals.total({now}.Pair(40, 2)))"
        ran = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ran.stdout.strip() == "42", ran.stderr
