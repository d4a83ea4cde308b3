"""What is counted in the library's sources: each function returns one figure by its name."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from roadscan.run.keys import reached_code
from tests.house.uncalled import of_repository

LIBRARY = Path(__file__).resolve().parents[2] / "roadscan"

WAYS = {
    "a reading": (
        "roadscan.formats.scanners.scans",
        "roadscan.tiles.tasks.tiles:compute_tiles",
        "roadscan.tiles.products.geotiff",
    ),
    "a crack": (
        "roadscan.formats.scanners.scans",
        "roadscan.tiles.tasks.tiles:compute_tiles",
        "roadscan.surface.tasks.surfaces:compute_surfaces",
        "roadscan.distress.products.crack_pieces",
        "roadscan.distress.products.cracks",
        "roadscan.condition.indices.cracking",
        "roadscan.condition.tasks.values",
    ),
    "a control point": ("roadscan.formats.vectors.control", "roadscan.adjust.tasks.adjustment"),
}
"""Entries of the code that something passes on its way from the log to the product."""

FEATURES = (
    "adjust(ment)?",
    "assets?",
    "condition",
    "control",
    "cracks?",
    "inventory",
    "lanes?",
    "navigat(e|ion)",
    "surfaces?",
)
"""Patterns of the words that name the files and folders of a feature."""

DIALECT = ("fates", "held", "mend", "own", "piles", "provisional", "sealed", "told", "valleys")
"""Words for which the field has a better one; counted where they stand alone."""


@cache
def sources() -> dict[Path, str]:
    """Text of each source file, by its path below the library."""
    return {file.relative_to(LIBRARY): file.read_text() for file in sorted(LIBRARY.rglob("*.py"))}


def size() -> dict[str, int]:
    """Lines and files, and the most lines of a file."""
    lines = [text.count("\n") for text in sources().values()]
    return {"lines": sum(lines), "files": len(lines), "lines of the longest file": max(lines)}


def budgets() -> dict[str, int]:
    """Lines of each folder of the library."""
    found: dict[str, int] = {}
    for file, text in sources().items():
        room = file.parts[0] if len(file.parts) > 1 else "."
        found[room] = found.get(room, 0) + text.count("\n")
    return {f"lines of {room}": lines for room, lines in found.items()}


def ways() -> dict[str, int]:
    """Files that something passes from the log to the product: those whose definitions the entries of its way reach."""
    return {
        f"files of the way of {name}": len({place.partition(":")[0] for place in reached_code(entries)})
        for name, entries in WAYS.items()
    }


def rooms() -> dict[str, int]:
    """Folders among which the files of a feature lie: the most, and the sum over the features."""
    found = [len({_room(file, word) for file in sources()} - {None}) for word in FEATURES]
    return {"most rooms of a feature": max(found), "rooms of all features": sum(found)}


def _room(file: Path, word: str) -> Path | None:
    """The folder that a feature names, or that of a file that it names."""
    named = re.compile(rf"(^|_){word}(_|$)")
    for depth, part in enumerate([*file.parts[:-1], file.stem]):
        if named.search(part):
            return Path(*file.parts[: min(depth + 1, len(file.parts) - 1)])
    return None


def words() -> dict[str, int]:
    """How often the words of the dialect stand in the library."""
    text = "\n".join(sources().values())
    return {"dialect words": sum(len(re.findall(rf"\b{word}\b", text)) for word in DIALECT)}


_IMPORTS_LLVM = re.compile(
    r"^from roadscan\.compute\.numba_internals import (?:\([^)]*|.*)\b(?:cgutils|ir|types)\b", re.MULTILINE
)
"""An import of LLVM's words from the module that hands them on."""


def private_names() -> dict[str, int]:
    """Files that name Numba's and LLVM's internals themselves, and files that write LLVM through the one that does."""
    found = {
        (file, name)
        for file, text in sources().items()
        for name in re.findall(r"\b(?:numba\.(?:core|cpython|np|typed|misc)|llvmlite)[\w.]*", text)
    }
    told = [file for file, text in sources().items() if _IMPORTS_LLVM.search(text)]
    return {
        "files with private names of Numba": len({file for file, _ in found}),
        "kernel files with LLVM words": len(told),
    }


def constants() -> dict[str, int]:
    """Constants of modules that hold a number, outside settings, and those of them without a sentence beside them."""
    told = [is_told for file, text in sources().items() if "settings" not in file.parts for is_told in _constants(text)]
    return {"constants": len(told), "constants without a sentence": told.count(False)}


def _constants(text: str) -> Iterator[bool]:
    """For each constant of a module that holds a number: whether a comment or a text stands beside it."""
    lines, body = text.splitlines(), ast.parse(text).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None or not _holds_number(node.value):
            continue
        above = lines[node.lineno - 2].strip() if node.lineno > 1 else ""
        beside = "\n".join(lines[node.lineno - 1 : node.end_lineno])
        yield "#" in beside or above.startswith("#") or (isinstance(after, ast.Expr) and after.lineno == _end(node) + 1)


def _end(node: ast.stmt) -> int:
    return node.end_lineno or node.lineno


def _holds_number(value: ast.expr) -> bool:
    return any(
        isinstance(part, ast.Constant) and isinstance(part.value, int | float) and not isinstance(part.value, bool)
        for part in ast.walk(value)
    )


def dead() -> dict[str, int]:
    """Functions, methods and plain classes that nothing of the library refers to and no page names."""
    return {"what nothing calls": len(of_repository())}


def figures() -> dict[str, int]:
    """All figures by name."""
    return size() | ways() | rooms() | words() | private_names() | constants() | dead() | budgets()
