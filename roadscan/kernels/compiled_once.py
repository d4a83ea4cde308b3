"""Among processes that share a cache, one compiles a kernel; the others wait for it and load it.

Workers that begin on an empty cache want the same kernels at the same moment. Without a lock each of them compiles
all of them, and of two that store variants of one kernel at once, Numba's index keeps only one.

A process waits for a kernel's lock with at most the locks of that kernel's callers in hand, and kernels do not call
one another in circles: nobody waits for ever. The system gives back the locks of a process that dies.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from numba.core.compiler_lock import global_compiler_lock

try:
    import fcntl
except ImportError:  # no such locks on this system: each process compiles for itself
    fcntl = None  # type: ignore[assignment]


def compile_once(dispatcher: Any, folder: str) -> None:
    """Let a kernel compile, or load what is compiled, with a lock of its own in the folder (which exists)."""
    function = dispatcher.py_func
    path = f"{folder}/{function.__module__}.{function.__qualname__}.lock"
    compile_now: Callable[[Any], Any] = dispatcher.compile
    inside = False

    def compile_alone(signature: Any) -> Any:
        nonlocal inside
        with global_compiler_lock:  # first the threads of this process, or two of them wait for each other
            if inside:
                return compile_now(signature)
            with _locked(path):
                inside = True
                try:
                    return compile_now(signature)
                finally:
                    inside = False

    dispatcher.compile = compile_alone


@contextlib.contextmanager
def _locked(path: str) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a folder that cannot be written, or has no locks
                fcntl.flock(stack.enter_context(open(path, "a")), fcntl.LOCK_EX)  # noqa: PTH123
        yield
