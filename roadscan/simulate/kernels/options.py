"""Compiler options of the simulator's kernels, and random numbers by counter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

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


@inlined
def mixed(counter: np.uint64) -> np.uint64:
    """Return 64 random bits for a counter: the finaliser of SplitMix64 (Steele, Lea, Flood 2014)."""
    z = counter * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
