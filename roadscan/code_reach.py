"""Digests of the code that an output depends on, so that a key changes with that code and with no other.

The unit is a definition: a function, a class, or a name that a module assigns. Starting from the function or class
that makes an output, every definition whose name occurs in one that is reached is reached as well, annotations
included (what a function is handed has the class that its annotation names). So an edit counts for an output only if
its making can come across the edited lines. Comments and docstrings do not count.

What is found by looking into a folder or at an entry point (formats, products, stages) is not reached, since no name
leads there: each of these belongs to the keys of its own outputs.

To walk the syntax trees of a hundred modules takes half a second. What a source says by names alone, its outline, is
kept on the disk beside the compiled kernels, with the digest of that source.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import gc
import hashlib
import importlib.util
import json
import secrets
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

from roadscan.private_folder import UnsafeFolderError, cache_place, check_private, make_private

Place: TypeAlias = tuple[str, str | None]
"""A module and a name in it; None for all of the module."""
Brought: TypeAlias = tuple[str, str, str | None]
"""A name that an import brings, the module that it names, and the name in that; None where it brings the module."""

CARRIERS: Final = (
    "roadscan.compiler",
    "roadscan.jobs.engine.compute",
    "roadscan.jobs.engine.fingerprint",
    "roadscan.model.errors",
    "roadscan.model.strict",
    "roadscan.model.survey:Survey",
    "roadscan.model.survey:SurveyConfig",
    "roadscan.tables.logs",
    "roadscan.tables.manifest",
    "roadscan.tables.records",
    "roadscan.tables.store",
)
"""What carries values and bytes, and shapes none: it is not followed. Settings count by their values, files by their
digests."""

_EFFECTS = "<statements>"
"""Stands for the statements of a module that define nothing: whoever uses the module depends on them."""


def code_digest(*entries: str) -> str:
    """Hash (16 hexadecimal digits) of all definitions that `entries` reach.

    Parameters
    ----------
    entries : "package.module:name", or "package.module" for all of a module.

    Raises
    ------
    LookupError
        if an entry does not exist.
    """
    _count_in(entry.partition(":")[0].partition(".")[0] for entry in entries)
    return _digest_of(entries)


def name_of(kind: type) -> str:
    """The entry of a class for :func:`code_digest`."""
    return f"{kind.__module__}:{kind.__qualname__.partition('.')[0]}"


@functools.cache
def _digest_of(entries: tuple[str, ...]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for place, text in sorted(reached_code(entries).items()):
        digest.update(f"{place}\0{text}\0".encode())
    return digest.hexdigest()


def reached_code(entries: Iterable[str]) -> dict[str, str]:
    """Source text, without comments and docstrings, of each definition ("module:name") that `entries` reach."""
    found: dict[str, str] = {}
    waiting = [_place_of(entry) for entry in entries]
    seen: set[Place] = set()
    while waiting:
        place = waiting.pop()
        if place in seen:
            continue
        seen.add(place)
        name, definition = place
        if name in CARRIERS or f"{name}:{definition}" in CARRIERS:
            continue
        module = _module(name)
        if definition is None:
            waiting += [(name, own) for own in module.texts]
        elif definition in module.texts:
            found[f"{name}:{definition}"] = module.texts[definition]
            waiting += [*module.uses[definition], (name, _EFFECTS)]
        elif definition in module.imports:  # handed on by a module that imports it
            waiting.append(module.imports[definition])
    return found


@dataclass
class _Module:
    """Definitions of a module: their texts, and what they use, by name."""

    texts: dict[str, str] = field(default_factory=dict)
    uses: dict[str, list[Place]] = field(default_factory=dict)
    imports: dict[str, Place] = field(default_factory=dict)
    """What a name that the module imports stands for."""


class _Definition(NamedTuple):
    """What a source says of a name that it defines."""

    name: str
    text: str
    names: list[str]
    """Names that occur in it."""
    brought: list[Brought]
    """By imports inside it."""


class _Outline(NamedTuple):
    """What a module's source says, whatever other modules there are."""

    brought: list[Brought]
    definitions: list[_Definition]


@functools.cache
def _module(name: str) -> _Module:
    file = _file_of(name)
    if file is None:
        raise LookupError(f"there is no module {name}")
    outline = _outline_of(name, file.read_bytes(), _package_of(name, file))
    module = _Module(texts={_EFFECTS: ""}, uses={_EFFECTS: []}, imports=_meant(outline.brought))
    known = {one.name for one in outline.definitions}
    for own, text, names, brought in outline.definitions:
        within, found = _meant(brought), dict[Place, None]()
        for used in names:
            if used in within:
                found[within[used]] = None
            elif used in known:
                found[name, used] = None
            elif used in module.imports:
                found[module.imports[used]] = None
        module.texts[own] = module.texts.get(own, "") + text
        module.uses[own] = module.uses.get(own, []) + list(found)
    return module


def _meant(brought: Iterable[Brought]) -> dict[str, Place]:
    """What each name stands for that imports bring, as far as a package of ours defines it."""
    found: dict[str, Place] = {}
    for name, source, inside in brought:
        if inside is None:
            if _file_of(source):
                found[name] = (source, None)
        elif _file_of(below := f"{source}.{inside}"):
            found[name] = (below, None)
        elif _file_of(source):
            found[name] = (source, inside)
    return found


def _outline_of(name: str, source: bytes, package: str) -> _Outline:
    """The outline of a module, as it was kept or made from its source and kept."""
    folder, digest = _kept_outlines(), hashlib.blake2b(package.encode() + b"\0" + source, digest_size=16).hexdigest()
    if folder is None:
        return _read_outline(source.decode(), package)
    file = folder / f"{name}.json"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        kept: dict[str, Any] = json.loads(file.read_bytes())
        if kept["of"] == digest:
            return _Outline(kept["brought"], [_Definition(*one) for one in kept["definitions"]])
    outline = _read_outline(source.decode(), package)
    scratch = file.with_suffix(f".{secrets.token_hex(4)}")
    with contextlib.suppress(OSError):
        scratch.write_text(json.dumps({"of": digest, **outline._asdict()}), encoding="utf-8")
        scratch.replace(file)
    return outline


@functools.cache
def _kept_outlines() -> Path | None:
    """Folder of the outlines that this code made; None where it cannot be written, or others could write to it."""
    version = hashlib.blake2b(Path(__file__).read_bytes(), digest_size=6).hexdigest()
    folder = cache_place() / f"outlines-{version}"
    try:
        make_private(folder)
        check_private(folder)
    except (OSError, UnsafeFolderError):
        return None
    return folder


def _read_outline(source: str, package: str) -> _Outline:
    with _uncollected():
        lines, tree = source.splitlines(), ast.parse(source)
        brought = [one for node in tree.body for one in _brought(node, package)]
        return _Outline(brought, [one for node in tree.body for one in _definitions(node, lines, package)])


def _definitions(node: ast.stmt, lines: list[str], package: str) -> Iterator[_Definition]:
    if not (defined := _names_of(node)):
        return
    parts = list(_parts(node))
    text = _text(node, parts, lines)
    names = list(dict.fromkeys(name for part in parts for name in _names_in(part)))
    brought = [one for part in parts if isinstance(part, _IMPORTS) for one in _brought(part, package)]
    for own in defined:
        yield _Definition(own, text, names, brought)


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Python's collector rests: it would look through a syntax tree again and again while that grows."""
    resting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if resting:
            gc.enable()


def _parts(node: ast.AST) -> Iterator[ast.AST]:
    """A statement and all below it, but operators and contexts."""
    waiting = [node]
    while waiting:
        part = waiting.pop()
        yield part
        for name in part._fields:
            below = getattr(part, name, None)
            if isinstance(below, list):
                waiting += [one for one in below if isinstance(one, ast.AST)]
            elif isinstance(below, ast.AST) and name not in ("ctx", "op"):
                waiting.append(below)


def _names_of(node: ast.stmt) -> list[str]:
    """Names that a statement of a module defines; what defines none is an effect, unless it only imports or tells."""
    match node:
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
            return [name]
        case ast.Import() | ast.ImportFrom() | ast.Expr(value=ast.Constant()):
            return []
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return []
        case ast.Assign() | ast.AnnAssign():
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
            plain = all(isinstance(target, ast.Name | ast.Tuple) for target in targets)
            return (names if plain else [_EFFECTS]) if names != ["__all__"] else []
    return [_EFFECTS]


def _text(node: ast.stmt, parts: Iterable[ast.AST], lines: list[str]) -> str:
    """Lines of a definition, without docstrings and lines that hold nothing but a comment."""
    decorators = getattr(node, "decorator_list", [])
    first = min([node.lineno, *(d.lineno for d in decorators)])
    told = {
        number
        for part in parts  # docstrings, and the texts under fields
        if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)
        for number in range(part.lineno, (part.end_lineno or 0) + 1)
    }
    kept = (lines[number - 1].rstrip() for number in range(first, (node.end_lineno or first) + 1) if number not in told)
    return "\n".join(line for line in kept if line and not line.lstrip().startswith("#")) + "\n"


_IMPORTS = (ast.Import, ast.ImportFrom, ast.If)


def _names_in(part: ast.AST) -> Iterator[str]:
    if isinstance(part, ast.Name):
        yield part.id
    elif isinstance(part, ast.arg | ast.AnnAssign) and isinstance(part.annotation, ast.Constant):
        yield from (n.id for n in ast.walk(ast.parse(str(part.annotation.value))) if isinstance(n, ast.Name))


def _brought(node: ast.AST, package: str) -> Iterator[Brought]:
    """What an import statement, or those under `if TYPE_CHECKING`, brings."""
    match node:
        case ast.If(test=ast.Name(id="TYPE_CHECKING"), body=body):
            for one in body:
                yield from _brought(one, package)
        case ast.Import(names=names):
            for alias in names:
                yield alias.asname or alias.name.partition(".")[0], alias.name, None
        case ast.ImportFrom(names=names):
            source = _absolute(node, package)
            for alias in names:
                yield alias.asname or alias.name, source, alias.name


def _absolute(node: ast.ImportFrom, package: str) -> str:
    if not node.level:
        return node.module or ""
    above = package.split(".")
    return ".".join([*above[: len(above) - node.level + 1], *([node.module] if node.module else [])])


def _place_of(entry: str) -> Place:
    module, _, name = entry.partition(":")
    if not _file_of(module) or (name and name not in _module(module).texts | _module(module).imports):
        raise LookupError(f"there is no definition {entry}")
    return module, name or None


def _package_of(name: str, file: Path) -> str:
    return name if file.name == "__init__.py" else name.rpartition(".")[0]


@functools.cache
def _file_of(module: str) -> Path | None:
    """Source of a module of roadscan, or of a package that an entry lies in; None for libraries."""
    top, _, below = module.partition(".")
    if top not in _OWN:
        return None
    spec = importlib.util.find_spec(top)
    if spec is None or spec.origin is None:
        return None
    if not below and not spec.submodule_search_locations:  # a package that is one file
        return Path(spec.origin)
    at = Path(spec.origin).parent.joinpath(*below.split(".")) if below else Path(spec.origin).parent
    return next((file for file in (at.with_suffix(".py"), at / "__init__.py") if file.is_file()), None)


_OWN = {"roadscan"}
"""Packages whose code counts."""


def _count_in(packages: Iterable[str]) -> None:
    """Let the code of further packages count: those that add a product or a stage of their own."""
    if new := set(packages) - _OWN:
        _OWN.update(new)
        for known in (_file_of, _module, _digest_of):
            known.cache_clear()
