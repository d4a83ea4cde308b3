"""Compiles loops with Numba: options, argument types, the cache on disk, and locks between processes.

Compiled code is cached on disk, in a folder named after the hash of the sources that it was made from: Numba itself
looks only at the file a function stands in, and would keep one whose inlined parts have changed elsewhere.

Among processes that share a cache, one compiles a function; the others wait for it and load it. Workers that begin on
an empty cache need the same functions at the same moment. Without a lock each of them compiles all of them, and of two
that store variants of one function at once, Numba's index keeps only one. A process that waits for a function's lock
has at most the locks of that function's callers, and calls have no cycles, so there is no deadlock. The operating
system releases the locks of a process that dies.

Compiled code is executed, so a cache that other users can write to is rejected.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from roadscan.compute import numba_internals
from roadscan.compute.numba_internals import (
    CACHES,
    KNOWN,
    PART,
    compiler_lock,
    forget,
    host_features,
    host_name,
    options,
)
from roadscan.core.private_folder import check_private, make_private

try:
    import fcntl
except ImportError:  # no such locks on this system: each process compiles for itself
    fcntl = None  # type: ignore[assignment]

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function, folder: str, *, counted: bool, entry: bool = True, inlined: bool = False) -> Function:
    """Compile a loop over arrays once per machine, serially, without the GIL.

    `fastmath` stays off, so that the order of operations, and with it every bit of the result, is the same everywhere.

    Parameters
    ----------
    folder : from :func:`cache_folder`.
    counted : references to arrays are counted; a function that creates no array does not need that. It may not return
        one either: its callers would release a reference that was never counted. Compiling such a function fails.
    entry : Python can call it. An entry takes longer to compile than a small function itself, so functions that only
        compiled functions call have none.
    inlined : only ever into the compiled functions that call it.
    """
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = folder  # read when the function is decorated
    try:
        made = numba.njit(
            nogil=True, cache=CACHES, error_model="numpy", forceinline=inlined, **options(counted=counted, entry=entry)
        )(function)
    finally:
        numba.config.CACHE_DIR = before
    if KNOWN and not numba.config.DISABLE_JIT:
        _compile_once(made, folder, counted=counted)
        if not entry:
            made.__class__ = PART
    return cast("Function", made)


def cache_folder(kind: str, sources: Iterable[Path]) -> str:
    """Folder for what is compiled from these files; made where it is not there.

    Raises
    ------
    UnsafeFolderError
        where another user could write to it, or did: what lies there is code.
    """
    digest = hashlib.blake2b(digest_size=6)
    for file in sorted({*sources, Path(__file__), Path(numba_internals.__file__)}, key=str):
        digest.update(file.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "roadscan" / f"{kind}-{digest.hexdigest()}"
    with contextlib.suppress(OSError):  # not writable: Numba says so, or looks for another place
        make_private(folder)
    check_private(folder)
    return str(folder)


def _compile_once(dispatcher: Any, folder: str, *, counted: bool) -> None:
    """Make a function compile, or load its compiled code, under a lock in the folder.

    A literal number counts as its type: Numba would otherwise compile a function, and all that it calls, once for a
    literal `0` and once more for an integer variable.
    """
    function = dispatcher.py_func
    path = f"{folder}/{function.__module__}.{function.__qualname__}.lock"
    compile_now: Callable[[Any], Any] = dispatcher.compile
    inside = False

    def compile_alone(signature: Any) -> Any:
        nonlocal inside
        signature = tuple(numba.types.unliteral(kind) for kind in signature)
        with compiler_lock:  # first the threads of this process, or two of them wait for each other
            if inside:
                return compile_now(signature)
            with _locked(path):
                inside = True
                try:
                    entry = compile_now(signature)
                except (ImportError, AttributeError):  # the cache names the class of an argument where it no longer is
                    forget(dispatcher)
                    entry = compile_now(signature)
                finally:
                    inside = False
        if not counted and _holds_array(dispatcher.overloads[signature].signature.return_type):
            raise TypeError(
                f"{function.__name__} counts no references and hands an array back: its callers would free it"
            )
        return entry

    dispatcher.compile = compile_alone


def _holds_array(kind: Any) -> bool:
    """Return whether a value of a type is an array, or a tuple with one."""
    if isinstance(kind, numba.types.BaseTuple):
        return any(_holds_array(part) for part in kind)
    return isinstance(kind, numba.types.Array)


@contextlib.contextmanager
def _locked(path: str) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a folder that cannot be written, or has no locks
                fcntl.flock(stack.enter_context(open(path, "a")), fcntl.LOCK_EX)  # noqa: PTH123
        yield


def _use_whole_registers() -> None:
    """Let the compiler use 512-bit registers where the processor has them; for old machines it prefers 256 bits.

    The processor is part of every compiled function's key, and is fixed when a process decorates its first one.
    """
    host = host_features()
    if "+avx512f" in host.split(",") and "NUMBA_CPU_FEATURES" not in os.environ:
        os.environ.setdefault("NUMBA_CPU_NAME", host_name())
        os.environ["NUMBA_CPU_FEATURES"] = host + ",-prefer-256-bit"
        numba.config.reload_config()


_use_whole_registers()
