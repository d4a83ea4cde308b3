"""Compiles loops with Numba: options, argument types, the cache on disk, and locks between processes.

Compiled code is cached on disk, in a folder named after the hash of the sources that it was made from: Numba itself
looks only at the file a function stands in, and would keep one whose inlined parts have changed elsewhere.

Among processes that share a cache, one compiles a function; the others wait for it and load it. Workers that begin on
an empty cache need the same functions at the same moment. Without a lock each of them compiles all of them, and of two
that store variants of one function at once, Numba's index keeps only one. A process that waits for a function's lock
has at most the locks of that function's callers, and calls have no cycles, so there is no deadlock. The operating
system releases the locks of a process that dies.

Compiled code is executed, so a cache that other users can write to is rejected.

Functions that only compiled functions call are stored as LLVM's bitcode. Numba would optimise each of them by itself
and generate machine code that nothing runs: their callers link the bitcode and are optimised with it.

Each compilation has a unique number in the names of its machine code, whichever process it ran in. Numba counts from 1
in every process, so that two functions of one name and signature (the variants that a factory makes) may get one name
in two processes; a third that loads both from the cache would silently call one of them for the other
(numba/numba, issue 10486).

The signature that a Numba function resolves for argument types is cached. Numba tries all of an operator's templates
again wherever it occurs, and formats an error for each that does not fit: a sixth of the time of a compilation.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast
from weakref import WeakKeyDictionary

import llvmlite.binding
import numba
from numba.core.bytecode import FunctionIdentity
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.targetconfig import ConfigStack
from numba.core.types.functions import BaseFunction

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
            nogil=True, cache=True, error_model="numpy", forceinline=inlined, _nrt=counted,
            no_cpython_wrapper=not entry, no_cfunc_wrapper=True, pipeline_class=Compiler if entry else _PartCompiler,
        )(function)  # fmt: skip
    finally:
        numba.config.CACHE_DIR = before
    if not numba.config.DISABLE_JIT:
        _compile_once(made, folder, counted=counted)
        if not entry:
            made.__class__ = _Part
    return cast("Function", made)


def cache_folder(kind: str, sources: Iterable[Path]) -> str:
    """Folder for what is compiled from these files; made where it is not there.

    Raises
    ------
    UnsafeFolderError
        where another user could write to it, or did: what lies there is code.
    """
    digest = hashlib.blake2b(digest_size=6)
    for file in sorted({*sources, Path(__file__)}, key=str):
        digest.update(file.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "roadscan" / f"{kind}-{digest.hexdigest()}"
    with contextlib.suppress(OSError):  # not writable: Numba says so, or looks for another place
        make_private(folder)
    check_private(folder)
    return str(folder)


class _Part(CPUDispatcher):  # type: ignore[misc]
    """A piece of compiled functions. A Python call would end the process, since it has no entry for one."""

    def __call__(self, *_: object, **__: object) -> None:
        raise TypeError(f"{self.py_func.__name__} is compiled for its callers only; Python calls a kernel")


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Bitcode of a part, which its callers link: it has no machine code, so no address and no environment at one."""

    def _optimize_final_module(self) -> None:
        manager, builder = self._codegen._module_pass_manager(
            loop_vectorize=False, slp_vectorize=False, opt=0, cost="cheap"
        )
        manager.run(self._final_module, builder)

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    serialize_using_object_code = JITCodeLibrary.serialize_using_bitcode

    def get_pointer_to_function(self, _: str) -> int:
        return 0

    @property
    def codegen(self) -> _PartLibrary:
        return self

    def set_env(self, *_: object) -> None:
        pass


class _PartCompiler(Compiler):  # type: ignore[misc]
    def compile_extra(self, function: Callable[..., Any]) -> Any:
        self.state.library = _PartLibrary(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


def _read_parts_as_bitcode() -> None:
    """Make Numba's cache restore parts as the bitcode that was stored."""
    read_code = JITCPUCodegen.unserialize_library

    def read(codegen: Any, stored: tuple[str, str, Any]) -> Any:
        name, kind, content = stored
        if kind != "bitcode":
            return read_code(codegen, stored)
        part = _PartLibrary(codegen, name)
        part._final_module = llvmlite.binding.parse_bitcode(content)
        part._finalize_final_module()
        return part

    JITCPUCodegen.unserialize_library = read


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
        with global_compiler_lock:  # first the threads of this process, or two of them wait for each other
            if inside:
                return compile_now(signature)
            with _locked(path):
                inside = True
                try:
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
    host = llvmlite.binding.get_host_cpu_features()
    if host.get("avx512f") and "NUMBA_CPU_FEATURES" not in os.environ:
        os.environ.setdefault("NUMBA_CPU_NAME", llvmlite.binding.get_host_cpu_name())
        os.environ["NUMBA_CPU_FEATURES"] = host.flatten() + ",-prefer-256-bit"
        numba.config.reload_config()


def _number_apart() -> None:
    """Number compilations so that no two processes use a number twice."""
    FunctionIdentity._unique_ids = iter(lambda: secrets.randbits(63), None)


def _keep_answers_of_types() -> None:
    """Cache the signature that a Numba function resolves for argument types, under the current options."""
    find_signature: Callable[..., Any] = BaseFunction.get_call_type
    kept_answers: WeakKeyDictionary[Any, dict[Any, Any]] = WeakKeyDictionary()

    def kept(function: Any, context: Any, types: tuple[Any, ...], named: dict[str, Any]) -> Any:
        options = ConfigStack.top_or_none()
        key = context, tuple(types), tuple(sorted(named.items())), options and repr(options._values)
        answers = kept_answers.setdefault(function, {})
        if key not in answers:
            answers[key] = find_signature(function, context, types, named)
        return answers[key]

    BaseFunction.get_call_type = kept  # type: ignore[method-assign, assignment]


_use_whole_registers()
_number_apart()
_read_parts_as_bitcode()
_keep_answers_of_types()
