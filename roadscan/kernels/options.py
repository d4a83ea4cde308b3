"""The one place that sets compiler options.

Kernels are serial and release the GIL: parallelism comes from Dask over blocks. `fastmath` stays off,
so that the order of operations, and with it every bit of the result, is the same everywhere.

Compiled code is cached on disk, in a folder named after the hash of a module's source and of the kernels that it
imports: Numba itself looks only at the file a function stands in, and would keep a kernel whose inlined parts have
changed elsewhere.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy.typing as npt

from roadscan.kernels.compiled_once import compile_once
from roadscan.registers import use_whole_registers

Kernel = Callable[..., Any]


def kernel(function: Kernel) -> Kernel:
    """Compile a loop over arrays once per machine, without the GIL."""
    return _compiled(function, forceinline=False)


def bare(function: Kernel) -> Kernel:
    """Compile a kernel that makes no array: it counts no references to those that it is given.

    To count a reference to and fro takes 20 ns; called for a thousand readings at a time, a kernel of ten arrays would
    take as long for that as for the readings.
    """
    return _compiled(function, forceinline=False, counted=False)


def inlined(function: Kernel) -> Kernel:
    """Compile a piece of a kernel into its callers; it takes numbers and tuples, no arrays in hot loops."""
    return _compiled(function, forceinline=True)


def bare_inlined(function: Kernel) -> Kernel:
    """Compile a piece of a `bare` kernel into it; it makes no array either."""
    return _compiled(function, forceinline=True, counted=False)


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The same array, not to be written to.

    What Arrow decoded is so already, what NumPy computed is not; a kernel that can get either, array by array, would
    be compiled for each mixture.
    """
    view = array.view()
    view.flags.writeable = False
    return view


def _compiled(function: Kernel, *, forceinline: bool, counted: bool = True) -> Kernel:
    before = numba.config.CACHE_DIR
    folder = _cache_folder(function.__code__.co_filename)
    numba.config.CACHE_DIR = folder  # read when the function is decorated
    try:
        decorate = numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=forceinline, _nrt=counted)
        compiled: Kernel = decorate(function)
    finally:
        numba.config.CACHE_DIR = before
    if not numba.config.DISABLE_JIT:
        compile_once(compiled, folder)
    return compiled


@functools.cache
def _cache_folder(source: str) -> str:
    """Folder for the compiled kernels of a source file."""
    here = Path(__file__).parent
    unseen, seen = [Path(source), Path(__file__)], set[Path]()
    while unseen:
        file = unseen.pop()
        if file not in seen:
            seen.add(file)
            unseen += [here / f"{name}.py" for name in _IMPORTED_KERNELS.findall(file.read_text(encoding="utf-8"))]
    digest = hashlib.blake2b(digest_size=6)
    for file in sorted(seen, key=lambda file: file.name):
        digest.update(file.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "roadscan" / f"kernels-{digest.hexdigest()}"
    with contextlib.suppress(OSError):  # not writable: Numba says so, or looks for another place
        folder.mkdir(parents=True, exist_ok=True)
    return str(folder)


_IMPORTED_KERNELS = re.compile(r"^from roadscan\.kernels\.(\w+) import", re.MULTILINE)
use_whole_registers()
