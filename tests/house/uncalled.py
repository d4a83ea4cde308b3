"""Functions, methods and plain classes of the library that neither it nor the flows refer to, and no page names.

What makes the pages of users (`docs/generate.py`) refers to what it tells.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
_CALLED_BY_OTHERS = re.compile(r"register|validator|command|callback")
"""Decorators that hand a function to a library, which calls it."""

_CODE = re.compile(r"```.*?```|`[^`\n]+`", re.DOTALL)
"""Code of a page."""


class Definition(NamedTuple):
    """A function, a method or a class."""

    file: Path
    name: str
    of_class: bool
    """True of methods."""
    first: int
    """Its first line, and its last one."""
    last: int


class Reference(NamedTuple):
    """A name where it is read, imported, or read of an object."""

    file: Path
    line: int
    how: str


def uncalled(texts: Mapping[Path, str], others: Mapping[Path, str], pages: str) -> list[str]:
    """Return what nothing refers to, as `file:name`.

    A function counts as called where its module reads its name outside of it, another module imports it by that name,
    or any reads an attribute of that name; a method where any reads an attribute of that name.

    Parameters
    ----------
    texts : sources in which definitions are looked for; others : more sources that may refer to them.
    pages : text of the pages: what they name is promised to users.
    """
    trees = {file: ast.parse(text) for file, text in {**texts, **others}.items()}
    own = {node.name for file in texts for node in trees[file].body if isinstance(node, ast.ClassDef)}
    named = {word for code in _CODE.findall(pages) for word in re.findall(r"\w+", code)}
    asked = [one for file in texts for one in _definitions(file, trees[file], own) if one.name not in named]
    references: dict[str, list[Reference]] = {one.name: [] for one in asked}
    for file, tree in trees.items():
        for name, one in _references(file, tree, references.keys()):
            references[name].append(one)
    return [f"{one.file}:{one.name}" for one in asked if not any(_refers(it, one) for it in references[one.name])]


def _definitions(file: Path, tree: ast.Module, own: set[str]) -> Iterator[Definition]:
    """Yield what is looked for: no method of a class that a library may call, no class that a registry may find."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            bases = {ast.unparse(base) for base in node.bases}
            if bases <= {"NamedTuple"}:
                yield Definition(file, node.name, False, node.lineno, node.end_lineno or 0)
            if bases <= own | {"NamedTuple", "ABC", "Strict"}:
                yield from (_definition(file, one, of_class=True) for one in node.body if _is_asked(one))
        elif _is_asked(node):
            yield _definition(file, node, of_class=False)


def _is_asked(node: ast.stmt) -> bool:
    if not isinstance(node, ast.FunctionDef) or node.name.startswith("__"):
        return False
    return not any(_CALLED_BY_OTHERS.search(ast.unparse(one)) for one in node.decorator_list)


def _definition(file: Path, node: ast.stmt, *, of_class: bool) -> Definition:
    return Definition(file, getattr(node, "name", ""), of_class, node.lineno, node.end_lineno or 0)


def _references(file: Path, tree: ast.Module, names: Set[str]) -> Iterator[tuple[str, Reference]]:
    """Yield where some names are read or imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            if node.id in names and isinstance(node.ctx, ast.Load):
                yield node.id, Reference(file, node.lineno, "read")
        elif isinstance(node, ast.Attribute):
            if node.attr in names and isinstance(node.ctx, ast.Load):
                yield node.attr, Reference(file, node.lineno, "attribute")
        elif isinstance(node, ast.ImportFrom):
            found = (one.name for one in node.names if one.name in names)
            yield from ((name, Reference(file, node.lineno, "imported")) for name in found)


def _refers(found: Reference, to: Definition) -> bool:
    if found.file == to.file and to.first <= found.line <= to.last:
        return False
    if found.how == "attribute":
        return True
    is_own = found.file == to.file
    return not to.of_class and (found.how == "imported" or is_own)


def _texts(folder: str, ending: str) -> dict[Path, str]:
    files = sorted((ROOT / folder).rglob(f"*.{ending}"))
    return {file.relative_to(ROOT): file.read_text(encoding="utf-8") for file in files}


def of_repository() -> list[str]:
    """Return what nothing of this repository refers to."""
    pages = [*_texts("docs", "md").values(), *((ROOT / name).read_text() for name in ("README.md", "CONTRIBUTING.md"))]
    others = {**_texts("flows", "py"), ROOT / "docs/generate.py": (ROOT / "docs/generate.py").read_text()}
    return uncalled(_texts("roadscan", "py"), others, "\n".join(pages))
