"""The kinds of kernels. Parallelism comes from Dask over blocks, never from inside a kernel."""

from __future__ import annotations

import ast
import functools
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from roadscan.core.private_folder import kept

if TYPE_CHECKING:
    import numpy.typing as npt

Kernel = Callable[..., Any]

_ONE_AT_A_TIME: Final = threading.RLock()
"""Two threads that call a kernel first would each hand it to Numba, and compile it twice."""


class _Late:
    """A function that Numba is given when it is first called, or compiled into a caller.

    To load Numba and to hand it the 600 functions that a survey's modules define takes half a second; who calls none of
    them does not wait for that.
    """

    def __init__(self, function: Kernel, **options: bool) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self._options = function, options
        self._made: Kernel | None = None

    def __call__(self, *given: Any, **named: Any) -> Any:
        return (self._made or self._compiled())(*given, **named)

    def __getattr__(self, name: str) -> Any:
        """Whatever Numba and tests ask of a compiled function, above all its type."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._made or self._compiled(), name)

    def __reduce__(self) -> str:
        return self.__qualname__  # type: ignore[no-any-return]

    def _compiled(self) -> Kernel:
        from roadscan.compute.compiler import compiled

        with _ONE_AT_A_TIME:
            if self._made is None:
                folder = _folder_of_source(self.py_func.__code__.co_filename)
                self._made = compiled(self.py_func, folder, **self._options)
        return self._made


def kernel(function: Kernel) -> Kernel:
    """Compile a loop over arrays into a kernel that Python calls."""
    return _Late(function, counted=True)


def inner(function: Kernel) -> Kernel:
    """Compile a loop that kernels alone call: an entry for Python would take as long to make as a small function."""
    return _Late(function, counted=True, entry=False)


def bare(function: Kernel) -> Kernel:
    """Compile a kernel that creates and returns no array: it does not count references to its arguments.

    Counting a reference up and down takes 20 ns; called for a thousand readings at a time, a kernel of ten arrays would
    spend as long on that as on the readings.
    """
    return _Late(function, counted=False)


def bare_inner(function: Kernel) -> Kernel:
    """Compile a loop that `bare` kernels alone call; it makes no array either."""
    return _Late(function, counted=False, entry=False)


def inlined(function: Kernel) -> Kernel:
    """Compile a piece of a kernel into its callers; it takes numbers and tuples, no arrays in hot loops."""
    return _Late(function, counted=True, entry=False, inlined=True)


def bare_inlined(function: Kernel) -> Kernel:
    """Compile a piece of a `bare` kernel into it; it makes no array either."""
    return _Late(function, counted=False, entry=False, inlined=True)


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only view of the array.

    Arrays that Arrow decoded are read-only already, those that NumPy computed are not; a kernel that gets either would
    be compiled for each mixture.
    """
    view = array.view()
    view.flags.writeable = False
    return view


@functools.cache
def _folder_of_source(source: str) -> str:
    """Folder for the compiled kernels of a source file: it changes with the file and the kernels that it imports."""
    from roadscan.compute.compiler import cache_folder

    file, library = Path(source), Path(__file__).parents[1]
    if not file.is_relative_to(library):
        return cache_folder("kernels", _reached(file))
    names = kept(
        f"kernels of {file.relative_to(library).as_posix()}",
        lambda: "\n".join(sorted(one.relative_to(library).as_posix() for one in _reached(file))),
    )
    return cache_folder("kernels", [library / name for name in names.split("\n")])


def _reached(file: Path) -> set[Path]:
    """The file, the kernel files that it imports, those that these import, and so on, with this file."""
    unseen, seen = [file, Path(__file__)], set[Path]()
    while unseen:
        one = unseen.pop()
        if one not in seen:
            seen.add(one)
            unseen += _imported_kernels(one)
    return seen


@functools.cache
def _imported_kernels(file: Path) -> list[Path]:
    """Return the kernel files of roadscan (in folders named `kernels`) that a file imports, anywhere in it."""
    library = Path(__file__).parents[1]
    within = ("roadscan", *file.parent.relative_to(library).parts) if file.is_relative_to(library) else ()
    found = []
    for node in _statements(ast.parse(file.read_bytes())):
        for name in _imported_names(node, within):
            if name[:1] == ("roadscan",) and "kernels" in name:
                module = library.joinpath(*name[1:])
                found += [file for file in (module.with_suffix(".py"), module / "__init__.py") if file.is_file()]
    return found


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements below a node. Expressions are skipped: they are most of a tree and hold no import."""
    for below in ast.iter_child_nodes(node):
        if isinstance(below, ast.stmt | ast.excepthandler | ast.match_case):
            yield below
            yield from _statements(below)


def _imported_names(node: ast.AST, within: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Yield what a statement may import, as parts of dotted names: modules, and names that may be modules in them.

    within : package that relative imports start from.
    """
    if isinstance(node, ast.Import):
        return [tuple(alias.name.split(".")) for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    own = tuple(node.module.split(".")) if node.module else ()
    package = (*within[: len(within) + 1 - node.level], *own) if node.level else own
    return [package, *((*package, alias.name) for alias in node.names)]
