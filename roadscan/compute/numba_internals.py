"""The one module that imports names of Numba and LLVM outside Numba's documented interface, and hands them on.

Eight files of kernels write instructions of LLVM with the names that they import from here: ``ir`` and ``cgutils``, and
``types`` of Numba. A Numba or LLVM that changes what these names mean breaks those files, and not this one alone
(``python -m tests.house`` counts them). What Numba itself is changed to do stands here alone.

Of a Numba whose internals were read (``KNOWN``), four things are changed, for this process:

- Functions that only compiled functions call are stored as LLVM's bitcode. Numba would optimise each of them by itself
  and generate machine code that nothing runs: their callers link the bitcode and are optimised with it. The same holds
  for the functions by which Numba stands in for NumPy's and Python's (`np.empty`, `max`, the pieces of a sort).
- Each compilation has a unique number in the names of its machine code, whichever process it ran in. Numba counts from
  1 in every process, so that two functions of one name and signature (the variants that a factory makes) may get one
  name in two processes; a third that loads both from the cache would silently call one of them for the other
  (numba/numba, issue 10486).
- The signature that a Numba function resolves for argument types is cached. Numba tries all of an operator's templates
  again wherever it occurs, and formats an error for each that does not fit: a sixth of the time of a compilation.
- No entry for Python, and no counts of references, where the caller of ``compiled`` says that none is needed.

Of another Numba only the numbers are, where it still has them; without them nothing is cached (``CACHES``). Functions
compile by Numba's documented options alone: they compute the same bits, compile for longer, and may be called from
Python where they would be refused.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import llvmlite.binding
import numba
from llvmlite import ir
from numba.core import cgutils, types

__all__ = [
    "CACHES",
    "KNOWN",
    "PART",
    "cgutils",
    "compiler_lock",
    "forget",
    "host_features",
    "host_name",
    "ir",
    "options",
    "types",
]


def forget(function: Any) -> None:
    """Empty the cache of a compiled function; it cannot be read where it names what has moved or is gone."""
    function._cache.flush()


KNOWN = numba.__version__.startswith("0.68.")
"""Whether the internals of this Numba are those that were read."""


def host_features() -> str:
    """Return LLVM's names of the features of this computer's processor: ``+avx2,-avx512f,…``."""
    features: str = llvmlite.binding.get_host_cpu_features().flatten()
    return features


def host_name() -> str:
    """Return the name that LLVM has for the processor of this computer."""
    name: str = llvmlite.binding.get_host_cpu_name()
    return name


def _number_apart() -> bool:
    """Number compilations so that no two processes use a number twice; return False where this Numba has no number."""
    try:
        from numba.core.bytecode import FunctionIdentity

        FunctionIdentity._unique_ids  # noqa: B018
    except (ImportError, AttributeError):
        return False
    FunctionIdentity._unique_ids = iter(lambda: secrets.randbits(63), None)
    return True


CACHES = _number_apart()
"""Whether compiled functions of several processes can be told apart, so that they may be cached on disk."""

if KNOWN:
    from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
    from numba.core.compiler import Compiler
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.registry import CPUDispatcher
    from numba.core.targetconfig import ConfigStack
    from numba.core.types.functions import BaseFunction
    from numba.core.typing.templates import _OverloadFunctionTemplate

    class _Part(CPUDispatcher):  # type: ignore[misc]
        """A piece of compiled functions. A Python call would end the process, since it has no entry for one."""

        def __call__(self, *_: object, **__: object) -> None:
            raise TypeError(f"{self.py_func.__name__} is compiled for its callers only; Python calls a kernel")

    class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
        """Bitcode of a part, which its callers link: it has no machine code, so no address and no environment."""

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

    def _link_what_numba_brings() -> None:
        """Make the functions by which Numba stands in for NumPy's and Python's bitcode, too."""
        find_decorator = _OverloadFunctionTemplate._get_jit_decorator

        def decorator(template: Any) -> Callable[..., Any]:
            compile_for: Callable[..., Any] = find_decorator(template)
            return lambda **given: compile_for(**{**given, "no_cfunc_wrapper": True, "pipeline_class": _PartCompiler})

        _OverloadFunctionTemplate._get_jit_decorator = decorator

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

    _read_parts_as_bitcode()
    _link_what_numba_brings()
    _keep_answers_of_types()

PART: Any = _Part if KNOWN else None
"""Class of a function that only compiled functions call; None where Numba's own serves."""
compiler_lock: Any = global_compiler_lock if KNOWN else contextlib.nullcontext()
"""Lock of the threads that compile; Numba takes it too."""


def options(*, counted: bool, entry: bool) -> dict[str, Any]:
    """Options of `numba.njit` beside the documented ones: counts of references, an entry for Python."""
    if not KNOWN:
        return {}
    return {
        "_nrt": counted, "no_cpython_wrapper": not entry, "no_cfunc_wrapper": True,
        "pipeline_class": Compiler if entry else _PartCompiler,
    }  # fmt: skip
