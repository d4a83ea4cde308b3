"""Compiler options of the simulator's kernels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from roadscan.compute import compiler

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile a kernel without reference counts of arrays, which take half of the time of these short functions.

    So nothing can be allocated inside; scratch arrays are handed in.
    """
    return compiler.compiled(function, _FOLDER, counted=False)


def inner(function: _Function) -> _Function:
    """Compile a function that only other kernels call, without an entry for Python, which takes long to compile."""
    return compiler.compiled(function, _FOLDER, counted=False, entry=False)


def inlined(function: _Function) -> _Function:
    """Compile a function into its callers, where passing the road's arrays costs more than the arithmetic."""
    return compiler.compiled(function, _FOLDER, counted=False, entry=False, inlined=True)


_FOLDER = compiler.cache_folder("simulate", Path(__file__).parent.glob("*.py"))
