"""Formats, products and stages are found: they lie in a folder of roadscan, or another package names them."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any, TypeVar

from roadscan.core.errors import ConfigError

Kind = TypeVar("Kind")


def found_kinds(package: str, base: type[Kind] | tuple[type[Kind], ...], group: str) -> dict[str, Any]:
    """Classes derived from `base`, by their `name`: those of a package's modules, and installed entry points.

    Parameters
    ----------
    package : dotted name; folders below it are looked into as well.
    group : name of the entry points.

    Raises
    ------
    ConfigError
        if two of them have one name.
    """
    found: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for kind, origin in _candidates(package, base, group):
        if kind.__abstractmethods__:
            continue
        if kind.name in found:
            raise ConfigError(
                f"'{kind.name}' is there twice: {origins[kind.name]} and {origin}", expected="a name of its own"
            )
        found[kind.name], origins[kind.name] = kind, origin
    return dict(sorted(found.items()))


def _candidates(package: str, base: Any, group: str) -> Iterator[tuple[Any, str]]:
    for module in _modules(package):
        for value in vars(module).values():
            if isinstance(value, type) and issubclass(value, base) and value.__module__ == module.__name__:
                yield value, module.__name__
    for entry in entry_points(group=group):
        yield entry.load(), f"entry point {entry.value}"


def _modules(package: str) -> Iterator[ModuleType]:
    there = importlib.import_module(package)
    for one in pkgutil.walk_packages(there.__path__, f"{package}."):
        yield importlib.import_module(one.name)
