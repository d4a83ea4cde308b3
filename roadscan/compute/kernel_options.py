"""The kinds of kernels. Parallelism comes from Dask over blocks, never from inside a kernel."""

from __future__ import annotations

import ast
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy.typing as npt

from roadscan.compute.compiler import cache_folder, compiled
from roadscan.core.kept import kept

Kernel = Callable[..., Any]


def kernel(function: Kernel) -> Kernel:
    """Compile a loop over arrays into a kernel that Python calls."""
    return compiled(function, _folder_of(function), counted=True)


def inner(function: Kernel) -> Kernel:
    """Compile a loop that kernels alone call: an entry for Python would take as long to make as a small function."""
    return compiled(function, _folder_of(function), counted=True, entry=False)


def bare(function: Kernel) -> Kernel:
    """Compile a kernel that creates and returns no array: it does not count references to its arguments.

    Counting a reference up and down takes 20 ns; called for a thousand readings at a time, a kernel of ten arrays would
    spend as long on that as on the readings.
    """
    return compiled(function, _folder_of(function), counted=False)


def bare_inner(function: Kernel) -> Kernel:
    """Compile a loop that `bare` kernels alone call; it makes no array either."""
    return compiled(function, _folder_of(function), counted=False, entry=False)


def inlined(function: Kernel) -> Kernel:
    """Compile a piece of a kernel into its callers; it takes numbers and tuples, no arrays in hot loops."""
    return compiled(function, _folder_of(function), counted=True, entry=False, inlined=True)


def bare_inlined(function: Kernel) -> Kernel:
    """Compile a piece of a `bare` kernel into it; it makes no array either."""
    return compiled(function, _folder_of(function), counted=False, entry=False, inlined=True)


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only view of the array.

    Arrays that Arrow decoded are read-only already, those that NumPy computed are not; a kernel that gets either would
    be compiled for each mixture.
    """
    view = array.view()
    view.flags.writeable = False
    return view


def _folder_of(function: Kernel) -> str:
    return _folder_of_source(function.__code__.co_filename)


@functools.cache
def _folder_of_source(source: str) -> str:
    """Folder for the compiled kernels of a source file: it changes with the file and the kernels that it imports."""
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
