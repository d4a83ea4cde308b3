"""Finds formats, products, stages and other kinds, in roadscan's modules and through packages' entry points."""

from __future__ import annotations

import functools
import importlib
import json
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Final, TypeVar, cast

from roadscan.core.errors import ConfigError
from roadscan.core.private_folder import kept

Kind = TypeVar("Kind")
_LIBRARY: Final = Path(__file__).parents[1]  # the package folder of roadscan


def found_kinds(
    place: str, base: type[Kind] | tuple[type[Kind], ...], group: str, name: str = "name"
) -> dict[str, Any]:
    """Return the classes derived from `base` by name, from roadscan's modules at a path and installed entry points.

    Parameters
    ----------
    place : pattern of the files of these modules, below the folder of roadscan (``"*/stage.py"``).
    group : name of the entry points; name : class variable that holds the name of a kind.

    Raises
    ------
    ConfigError
        if two of them have one name.
    """
    found: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for kind, origin in _candidates(place, base, group):
        called = getattr(kind, name, None)
        if kind.__abstractmethods__ or called is None:
            continue
        if called in found:
            raise ConfigError(
                f"'{called}' is there twice: {origins[called]} and {origin}", expected="a name of its own"
            )
        found[called], origins[called] = kind, origin
    return dict(sorted(found.items()))


def kind_named(
    called: str, place: str, base: type[Kind] | tuple[type[Kind], ...], group: str, name: str = "name"
) -> Any | None:
    """Return one class of :func:`found_kinds`, or None; no module of another kind is imported where none was added.

    Which module holds it is found once for the sources as they are, by importing all of them.
    """
    if added(group):
        return found_kinds(place, base, group, name).get(called)
    modules: dict[str, str] = json.loads(
        kept(
            f"modules of {place} by {name}",
            lambda: json.dumps({one: k.__module__ for one, k in found_kinds(place, base, group, name).items()}),
        )
    )
    if called not in modules:
        return None
    kinds = _kinds_in(importlib.import_module(modules[called]), base)
    return next(kind for kind in kinds if getattr(kind, name, None) == called)


def _kinds_in(module: ModuleType, base: Any) -> Iterator[Any]:
    for value in vars(module).values():
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == module.__name__:
            yield value


def _candidates(place: str, base: Any, group: str) -> Iterator[tuple[Any, str]]:
    for module in modules_at(place):
        yield from ((kind, module.__name__) for kind in _kinds_in(module, base))
    for entry in added(group):
        yield entry.load(), f"entry point {entry.value}"


def added(group: str) -> EntryPoints:
    """Return the entry points of installed packages in a group."""
    return _entry_points(tuple(sys.path)).select(group=group)


@functools.cache
def _entry_points(_path: tuple[str, ...]) -> EntryPoints:
    """Return all entry points of the packages on a path: to read them takes as long for one group as for all."""
    return cast("EntryPoints", entry_points())


def modules_at(place: str) -> Iterator[ModuleType]:
    """Import the modules of roadscan whose files match a pattern, one by one."""
    for file in files_at(place):
        yield importlib.import_module(".".join(file.relative_to(_LIBRARY.parent).with_suffix("").parts))


def files_at(place: str) -> list[Path]:
    """Return files of roadscan that match a pattern, without importing them; ``__init__`` files are left out."""
    return sorted(file for file in _LIBRARY.glob(place) if not file.name.startswith("__"))
