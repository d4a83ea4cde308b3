"""How the simulator's loops are compiled."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from roadscan.compute import compiler

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile a loop. It counts no references to arrays: for these short functions that took half of the time.

    So nothing can be allocated inside; scratch arrays are handed in.
    """
    return compiler.compiled(function, _FOLDER, counted=False)


def inner(function: _Function) -> _Function:
    """Compile a loop that other loops alone call: an entry for Python takes as long to make as a small function."""
    return compiler.compiled(function, _FOLDER, counted=False, entry=False)


def inlined(function: _Function) -> _Function:
    """Compile a piece of a loop into its callers: handing on the road's arrays costs more than the arithmetic."""
    return compiler.compiled(function, _FOLDER, counted=False, entry=False, inlined=True)


_FOLDER = compiler.cache_folder("simulate", Path(__file__).parent.glob("*.py"))
