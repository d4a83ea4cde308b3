"""The one place that sets compiler options of the simulator's loops.

Compiled code is cached in a folder named after the hash of all of them: Numba looks only at the file a function
stands in, and would keep one whose inlined parts have changed elsewhere.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from roadscan.registers import use_whole_registers

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile serially, without the GIL; `fastmath` stays off so that results do not change.

    Numba's memory manager is off: counting references to the arrays of these short functions took half of the time.
    So nothing can be allocated inside; scratch arrays are handed in.
    """
    return _made(function, forceinline=False)


def inlined(function: _Function) -> _Function:
    """Compile a piece of a loop into its callers: handing on the road's arrays costs more than the arithmetic."""
    return _made(function, forceinline=True)


def _made(function: _Function, *, forceinline: bool) -> _Function:
    options = {"nogil": True, "cache": True, "error_model": "numpy", "_nrt": False, "forceinline": forceinline}
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _CACHE_FOLDER  # read when the function is decorated
    try:
        return cast("_Function", numba.njit(**options)(function))
    finally:
        numba.config.CACHE_DIR = before


def _cache_folder() -> str:
    digest = hashlib.blake2b(digest_size=6)
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return str(Path(base) / "roadscan" / f"simulate-{digest.hexdigest()}")


_CACHE_FOLDER = _cache_folder()
use_whole_registers()
