"""Keys: short hashes of everything on which an output depends, and digests of the code that makes it.

Digests of the code on which an output depends, so that a key changes with that code and no other.

The unit is a definition: a function, a class, or a name that a module assigns. Starting from the function or class
that makes an output, every definition whose name occurs in one that is reached is reached as well, annotations
included (what a function is handed has the class that its annotation names). So an edit counts for an output only if
its making can come across the edited lines.

A definition counts by its shape: its syntax tree, in which each definition of ours that it names is a number, in the
order in which they are reached. So comments, docstrings, line breaks, the file in which a definition stands and its
name do not count: to move or to rename one leaves every output current, but where modules are joined that both import
a type of arrays (`ARRAY_TYPES`). Names of attributes, of arguments and of local variables count.

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
import re
import secrets
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from roadscan.core.crs import Geoid
from roadscan.core.private_folder import UnsafeFolderError, cache_place, check_private, kept, make_private

Place: TypeAlias = tuple[str, str | None]
"""A module and a name in it; None for all of the module."""
Brought: TypeAlias = tuple[str, str, str | None]
"""A name that an import binds, the module it comes from, and its name there; None where it binds the module."""

CARRIERS: Final = (
    "roadscan.compute.compiler",
    "roadscan.compute.kernel_options",
    "roadscan.core.private_folder",
    "roadscan.core.plugins",
    "roadscan.run.keys",
    "roadscan.run.engine.compute",
    "roadscan.run.session",
    "roadscan.core.errors",
    "roadscan.core.extras",
    "roadscan.core.strict",
    "roadscan.core.survey:Survey",
    "roadscan.core.survey:SurveyConfig",
    "roadscan.georeference.plan.plan:poses_plan_of",
    "roadscan.store.logs",
    "roadscan.store.manifest",
    "roadscan.store.records",
    "roadscan.store.store",
)
"""Modules left out of the digest: they transport data and change no result. Settings are covered by their values, files
by their digests, a plan by the keys of its sources."""

ARRAY_TYPES: Final = "roadscan.compute.array_types"
"""Module whose definitions count as if each module that imports them had written them: short names for types of arrays.
So a module may import such a name or write it, and its outputs stay current."""

_EFFECTS = "<statements>"
"""Name for the statements of a module that define nothing: every user of the module depends on them."""


def code_digest(*entries: str) -> str:
    """Return a hash (16 hexadecimal digits) of all definitions that `entries` reach.

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
    """Return the entry of a class for :func:`code_digest`."""
    return f"{kind.__module__}:{kind.__qualname__.partition('.')[0]}"


@functools.cache
def _digest_of(entries: tuple[str, ...]) -> str:
    if {"roadscan"} != _OWN:  # code of other packages counts too
        return _computed(entries)
    return kept(f"digest of {' '.join(entries)}", lambda: _computed(entries))


def _computed(entries: tuple[str, ...]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for text in reached_code(entries).values():
        digest.update(f"{text}\0".encode())
    return digest.hexdigest()


def reached_code(entries: Iterable[str]) -> dict[str, str]:
    """Return the shape of each definition ("module:name") that `entries` reach, in the order they are reached."""
    waiting = deque(_place_of(entry) for entry in entries)
    numbers: dict[Place, int] = {}
    entered: dict[str, None] = {}
    while waiting:
        place = _origin(waiting.popleft())
        if place not in numbers and not _is_carrier(place):
            shapes = _module(place[0]).shapes
            if place[1] is None:
                waiting += [(place[0], own) for own in shapes if own != _EFFECTS]
            else:
                numbers[place] = len(numbers)
                waiting += [used for shape in shapes.get(place[1], ()) for used in shape.uses.values()]
            entered[place[0]] = None
        if not waiting:  # last: the file of a definition does not change any number
            effects = [(name, _EFFECTS) for name in entered if _module(name).shapes[_EFFECTS]]
            waiting += [one for one in effects if one not in numbers]
    return {f"{name}:{own}": _numbered((name, own), numbers) for name, own in numbers if own in _module(name).shapes}


def _origin(place: Place) -> Place:
    """Return where a name is defined that a module only re-exports."""
    name, definition = place
    if definition is None or _is_carrier(place):
        return place
    module = _module(name)
    handed_on = None if definition in module.shapes else module.imports.get(definition)
    return _origin(handed_on) if handed_on else place


def _is_carrier(place: Place) -> bool:
    return place[0] in CARRIERS or f"{place[0]}:{place[1]}" in CARRIERS


def _numbered(place: Place, numbers: dict[Place, int]) -> str:
    """Return the shapes of a definition, with numbers in place of the names of our definitions."""
    module, texts = _module(place[0]), []
    for shape in module.shapes[place[1] or ""]:
        words = [shape.libraries.get(name, name) for name in shape.names]
        for at, name in enumerate(shape.names):
            if name in shape.uses and (used := _origin(shape.uses[name])) in numbers:
                words[at] = f"#{numbers[used]}"
        parts = _NAME.split(shape.text)  # text and numbers of names alternate
        parts[1::2] = [words[int(number)] for number in parts[1::2]]
        texts.append("".join(parts))
    return "\n".join(texts)


@dataclass
class _Shape:
    """Definition by a statement of a module: its text, and the meaning of the names in it."""

    text: str
    """Its syntax tree, with a mark for each of `names`."""
    names: list[str]
    uses: dict[str, Place] = field(default_factory=dict)
    """Names of our definitions."""
    libraries: dict[str, str] = field(default_factory=dict)
    """Full names of what is imported from libraries."""


@dataclass
class _Module:
    """Definitions of a module."""

    shapes: dict[str, list[_Shape]] = field(default_factory=dict)
    """Shapes by name; several where several statements define it."""
    imports: dict[str, Place] = field(default_factory=dict)
    """Meaning of each imported name."""


class _Definition(NamedTuple):
    """A source's definition of a name."""

    name: str
    text: str
    names: list[str]
    """Names that occur in it."""
    brought: list[Brought]
    """Imports inside it."""


class _Outline(NamedTuple):
    """Content of a module's source, independent of other modules."""

    brought: list[Brought]
    definitions: list[_Definition]


@functools.cache
def _module(name: str) -> _Module:
    file = _file_of(name)
    if file is None:
        raise LookupError(f"there is no module {name}")
    outline = _outline_of(name, file.read_bytes(), _package_of(name, file))
    imports, libraries = _meant(outline.brought)
    written = {
        own: [replace(shape, uses={str(inside): (name, own)}) for shape in _module(source).shapes[str(inside)]]
        for own, (source, inside) in imports.items()
        if source == ARRAY_TYPES
    }
    module = _Module(shapes={_EFFECTS: [], **written}, imports=imports)
    known = {one: (name, one) for one in (*written, *(one.name for one in outline.definitions))}
    for own, text, names, brought in outline.definitions:
        within, within_libraries = _meant(brought)
        ours = imports | known | within
        shape = _Shape(text, names, {one: ours[one] for one in names if one in ours}, libraries | within_libraries)
        module.shapes.setdefault(own, []).append(shape)
    return module


def _meant(brought: Iterable[Brought]) -> tuple[dict[str, Place], dict[str, str]]:
    """Return the meaning of each imported name: a place in a package of ours, or the full name in a library."""
    places: dict[str, Place] = {}
    libraries: dict[str, str] = {}
    for name, source, inside in brought:
        if inside is None and _file_of(source):
            places[name] = (source, None)
        elif inside is not None and _file_of(below := f"{source}.{inside}"):
            places[name] = (below, None)
        elif inside is not None and _file_of(source):
            places[name] = (source, inside)
        else:
            libraries[name] = f"{source}.{inside}" if inside else source
    return places, libraries


def _outline_of(name: str, source: bytes, package: str) -> _Outline:
    """Return the outline of a module from the cache, or create it and cache it."""
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
    """Return the cache folder of outlines; None where it cannot be written, or others could write to it."""
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
        tree = ast.parse(source)
        brought = [one for node in tree.body for one in _brought(node, package)]
        return _Outline(brought, [one for node in tree.body for one in _definitions(node, package)])


def _definitions(node: ast.stmt, package: str) -> Iterator[_Definition]:
    if not (defined := _names_of(node)):
        return
    names = dict[str, int]()
    text = "".join(_shape(node, names, ("name",)))
    brought = [one for part in ast.walk(node) if isinstance(part, _IMPORTS) for one in _brought(part, package)]
    for own in defined:
        yield _Definition(own, text, list(names), brought)


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Suspend garbage collection, which would scan a growing syntax tree again and again."""
    resting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if resting:
            gc.enable()


def _names_of(node: ast.stmt) -> list[str]:
    """Return the names that a statement defines; others are effects, unless they are imports or docstrings."""
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


def _shape(part: object, names: dict[str, int], without: Iterable[str] = ()) -> Iterator[str]:
    """Yield the text of a syntax tree without docstrings, with a mark for each name, which `names` numbers.

    It does not differ between versions of Python, as that of :func:`ast.dump` does.
    """
    match part:
        case ast.Expr(value=ast.Constant(value=str())) | ast.Import() | ast.ImportFrom():
            return  # imported names follow the names
        case ast.Name(id=name):
            yield f"\1{names.setdefault(name, len(names))}\2"
        case ast.AST():
            yield f"{type(part).__name__}("
            for name, below in ast.iter_fields(part):
                if below is None or below == [] or name in _UNCOUNTED or name in without:
                    continue
                yield f"{name}="
                if name == "annotation" and isinstance(below, ast.Constant):
                    below = ast.parse(str(below.value), mode="eval").body  # noqa: PLW2901
                yield from _shape(below, names)
            yield ")"
        case list():
            for one in part:
                yield from _shape(one, names)
            yield ";"
        case _:
            yield f"{part!r},"


_NAME = re.compile("\1(\\d+)\2")
_UNCOUNTED = frozenset({"ctx", "kind", "type_comment", "type_ignores"})


_IMPORTS = (ast.Import, ast.ImportFrom, ast.If)


def _brought(node: ast.AST, package: str) -> Iterator[Brought]:
    """Yield the names bound by an import statement, or by those under `if TYPE_CHECKING`."""
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
    if not _file_of(module) or (name and name not in _module(module).shapes | _module(module).imports):
        raise LookupError(f"there is no definition {entry}")
    return module, name or None


def _package_of(name: str, file: Path) -> str:
    return name if file.name == "__init__.py" else name.rpartition(".")[0]


@functools.cache
def _file_of(module: str) -> Path | None:
    """Return the source file of a module of roadscan, or of a package with an entry; None for libraries."""
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
    """Include the code of further packages: those that add a product or a stage."""
    if new := set(packages) - _OWN:
        _OWN.update(new)
        for known in (_file_of, _module, _digest_of):
            known.cache_clear()


def key_of(*parts: Any) -> str:
    """Return sixteen hexadecimal digits for JSON-like values (order matters, dictionaries are sorted)."""
    text = json.dumps(parts, sort_keys=True, default=str, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def keys_of(common: str, content: npt.NDArray[np.void], ends: npt.NDArray[np.int64]) -> list[str]:
    """Return a key for each part of an array of records, (parts,) `ends` of the parts; `common` enters all keys.

    Faster than :func:`key_of` for the tiles of a network.
    """
    begun = hashlib.blake2b(common.encode(), digest_size=8)
    stream, size, start, found = memoryview(content.tobytes()), content.dtype.itemsize, 0, []
    for end in (size * ends).tolist():
        one = begun.copy()
        one.update(stream[start:end])
        found.append(one.hexdigest())
        start = end
    return found


def keys_beside(keys: Sequence[str], other: str) -> list[str]:
    """Return ``key_of(key, other)`` for each of many keys, which are hexadecimal digits."""
    end = f'",{json.dumps(other)}]'
    return [hashlib.blake2b(f'["{key}{end}'.encode(), digest_size=8).hexdigest() for key in keys]


def grid_key(geoid: Geoid | None) -> list[str] | None:
    """Return name and content of a geoid grid: a replaced grid counts as another one."""
    return None if geoid is None else [geoid.grid, geoid.content]
