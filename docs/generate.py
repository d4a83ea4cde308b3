"""Writes the generated pages of this folder from the code that they describe.

    python docs/generate.py           write the pages
    python docs/generate.py --check   fail where a page is out of date

A page is a template of ``docs/pages`` in which every line ``{{directive argument}}`` is replaced: tables of
columns come from ``schemas/``, settings from the configuration models, formats and products from their
registries. Prose stands in the templates and in docstrings, numbers and names nowhere but in the code.
"""

from __future__ import annotations

import ast
import datetime as dt
import enum
import importlib
import inspect
import re
import sys
import textwrap
import types
from collections.abc import Callable, Iterable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from roadscan.assets.kind import AssetKind, asset_kinds
from roadscan.assets.pictures.sign_types import listed_types
from roadscan.core.strict import meanings
from roadscan.core.witness import Witness, witnesses
from roadscan.ingest.inspect.file_kinds import known_files
from roadscan.ingest.reading.format import LogFormat, log_formats
from roadscan.store.asset_schema import AssetColumn, AssetSchema, asset_kind_names, asset_schema
from roadscan.store.readings.packed_returns import beams_query, returns_query
from roadscan.store.schema import TableSchema, schema_folder, schema_names, table_schema
from roadscan.tiles.product import Product, SurfaceProduct, TileFiles, products

DOCS: Final = Path(__file__).resolve().parent
TEMPLATES: Final = DOCS / "pages"
NOTE: Final = (
    "<!-- Written by docs/generate.py from docs/pages/{name} and the code: change those, then `make docs`. -->\n\n"
)

_DIRECTIVE: Final = re.compile(r"^\{\{(\w+)(?: (\S+))?\}\}$", re.MULTILINE)


def pages() -> dict[Path, str]:
    """Content of every generated page by path."""
    return {DOCS / file.name: page(file) for file in sorted(TEMPLATES.glob("*.md"))}


def page(template: Path) -> str:
    """One page from its template."""
    text = _DIRECTIVE.sub(lambda found: DIRECTIVES[found[1]](found[2] or ""), template.read_text(encoding="utf-8"))
    return NOTE.format(name=template.name) + text.rstrip() + "\n"


def stale(written: dict[Path, str]) -> list[Path]:
    """Pages on disk that differ from what the code says."""
    return [p for p, text in written.items() if not p.is_file() or p.read_text(encoding="utf-8") != text]


def main(arguments: list[str]) -> int:
    """Write the pages, or check them; the exit code."""
    written = pages()
    old = stale(written)
    if "--check" in arguments:
        for path in old:
            print(f"{path.relative_to(DOCS.parent)} is out of date: run `make docs` and commit the result")
        return 1 if old else 0
    for path in old:
        path.write_text(written[path], encoding="utf-8")
        print(f"wrote {path.relative_to(DOCS.parent)}")
    return 0


# --- configuration models -----------------------------------------------------------------------


def fields(target: str) -> str:
    """Table of the settings of a model, named ``module:Class``, or ``module:function`` that returns it."""
    found = _load(target)
    return fields_table(found if isinstance(found, type) else found())


def fields_table(model: type[BaseModel]) -> str:
    """Table of a model's settings: key, type, default, meaning."""
    said = meanings(model)
    rows = [
        (f"`{name}`", type_words(info), default_words(info), one_line(said[name]))
        for name, info in model.model_fields.items()
    ]
    return markdown_table(("key", "type", "default", "meaning"), rows)


def model(target: str) -> str:
    """What a model is for, by its docstring, and the table of its settings."""
    kind = _load(target)
    return "\n\n".join([markdown(inspect.cleandoc(kind.__doc__ or "")), fields_table(kind)])


def type_words(info: FieldInfo) -> str:
    """A field's type as a reader of a TOML file would name it, with its limits."""
    limits = [words for limit in info.metadata for words in _limit_words(limit)]
    return ", ".join([_type(info.annotation), *limits])


def default_words(info: FieldInfo) -> str:
    """A field's default as it would be written in TOML."""
    if info.is_required():
        return "**required**"
    value = info.get_default(call_default_factory=True)
    if value is None or value in ({}, [], ""):
        return "—"
    if isinstance(value, BaseModel) and not value.model_fields_set:
        return "its own defaults"
    return "no limit" if value == float("inf") else f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, BaseModel):
        return (
            "{ " + ", ".join(f"{name} = {_toml(v)}" for name, v in value.model_dump(exclude_unset=True).items()) + " }"
        )
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, dt.datetime):
        return value.isoformat().replace("+00:00", "Z")
    return f"{value:.10g}" if isinstance(value, float) else str(value)


_PLAIN: Final[dict[Any, str]] = {
    str: "text",
    int: "whole number",
    float: "number",
    bool: "true or false",
    Path: "path",
    dt.date: "date",
    dt.datetime: "date and time",
    Any: "any",
}


def _type(annotation: Any) -> str:
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        return _choice(member.value for member in annotation)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return _choice(arguments)
    if origin is Annotated:
        limits = [
            words for one in arguments[1:] for limit in getattr(one, "metadata", [one]) for words in _limit_words(limit)
        ]
        return ", ".join([_type(arguments[0]), *limits])
    if origin in {Union, types.UnionType}:
        return " or ".join(_type(a) for a in arguments if a is not types.NoneType)
    if origin is dict:
        inner = "" if arguments[1] is Any else _type(arguments[1])
        return {"": "table", "table": "tables by name"}.get(inner, f"table of {inner} by name")
    if origin is tuple and Ellipsis not in arguments:
        return f"list of {len(arguments)} {_plural(_type(arguments[0]))}"
    if origin in {list, tuple}:
        inner = _type(arguments[0])
        return f"list, each {inner}" if " or " in inner or inner.startswith("one of") else f"list of {_plural(inner)}"
    raise TypeError(f"no words for the type {annotation!r}: add them to docs/generate.py")


def _choice(values: Iterable[Any]) -> str:
    words = [f"`{_toml(value)}`" for value in values]
    return " or ".join(words) if len(words) < 3 else "one of " + ", ".join(words)


def _plural(words: str) -> str:
    if words.startswith("list of"):
        return "lists" + words.removeprefix("list")
    return words + "s" if words in {"table", "number", "whole number", "path"} else words


def _limit_words(limit: Any) -> Iterable[str]:
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    for name, sign in signs.items():
        if getattr(limit, name, None) is not None:
            yield f"{sign} {getattr(limit, name):g}"
    if getattr(limit, "min_length", None):
        yield f"at least {limit.min_length}"
    if getattr(limit, "pattern", None):
        yield f"matching `{limit.pattern}`"


def members(target: str) -> str:
    """Table of an enumeration's values with the docstrings below them."""
    kind = _load(target)
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    meanings: dict[str, str] = {}
    name = ""
    for node in getattr(body, "body", []):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and name:
            meanings[name] = str(node.value.value)
    return markdown_table(("value", "meaning"), [(f'`"{m.value}"`', one_line(meanings[m.name])) for m in kind])


# --- tables -------------------------------------------------------------------------------------


def tables(_: str) -> str:
    """All tables of ``schemas/`` with their columns."""
    return "\n\n".join(_table_section(table_schema(name)) for name in schema_names())


def packed_view(folder: str) -> str:
    """Statements by which DuckDB alone has the packed returns of a folder as rows of `returns`."""
    parts = {
        "packed_returns": f"SELECT * FROM read_parquet('{folder}/**/*.parquet', hive_partitioning = true)",
        "beams": beams_query(f"'{folder}/*/*/*/*/part-00000.parquet'"),
        "returns": returns_query(),
    }
    return "\n\n".join(f"CREATE VIEW {name} AS\n{query};" for name, query in parts.items())


def _table_section(schema: TableSchema) -> str:
    partition = f"Partitioned by {schema.partition_s} s of GPS time. " if schema.partition_s else ""
    partition += f"Lies in `{schema.location}`. " if schema.location else ""
    order = f"Sorted by {', '.join(f'`{name}`' for name in schema.sort)}."
    rows = [
        (
            f"`{c.name}`",
            c.type + (", may be null" if c.nullable else ""),
            c.unit,
            c.frame or "—",
            c.meaning + "".join(_range_words(c.min, c.max)),
        )
        for c in schema.columns
    ]
    columns = markdown_table(("column", "type", "unit", "frame", "meaning"), rows)
    return f"## {schema.name}\n\n{schema.meaning}\n\n{partition}{order}\n\n{columns}"


def _range_words(lowest: float | None, highest: float | None) -> Iterable[str]:
    if lowest is not None and highest is not None:
        yield f" From {lowest:g} to {highest:g}."
    elif lowest is not None:
        yield f" {lowest:g} or more."
    elif highest is not None:
        yield f" {highest:g} or less."


def asset_columns(_: str) -> str:
    """Columns that the tables of all kinds of assets have."""
    return _asset_table(asset_schema(asset_kind_names()[0]).common)


def asset_list(_: str) -> str:
    """A section for each kind of assets: its table, its own columns, how it is found, its settings."""
    known = _own(asset_kinds(), "roadscan.asset_kinds")
    names = [one.kind for one in _own_schemas() if not one.found_in]
    return "\n\n".join(part for name in names for part in _asset_section(name, known.get(name)))


def distress_list(_: str) -> str:
    """A section for each kind of distress that the inventory holds: its table and its own columns."""
    return "\n\n".join(part for one in _own_schemas() if one.found_in for part in _asset_section(one.kind, None))


def _own_schemas() -> list[AssetSchema]:
    """Schemas of the kinds that roadscan itself knows."""
    folder = schema_folder() / "assets"
    return [asset_schema(name) for name in asset_kind_names() if (folder / f"{name}.toml").is_file()]


def _asset_section(name: str, kind: AssetKind | None) -> Iterable[str]:
    schema = asset_schema(name)
    shapes = {"PointZ": "points", "LineStringZ": "lines", "PolygonZ": "polygons",
              "MultiLineStringZ": "lines of several parts", "MultiPolygonZ": "polygons of several parts"}  # fmt: skip
    yield f"### `{name}`\n\n{schema.meaning} Table `{schema.table}`, {shapes[schema.geometry]}."
    if kind is not None:
        yield from manual(type(kind))
    yield _asset_table(schema.own)
    if kind is not None and kind.options.model_fields:
        yield f"Settings (`[assets.options.{name}]`):"
        yield fields_table(kind.options)


def _asset_table(columns: Iterable[AssetColumn]) -> str:
    rows = [
        (
            f"`{c.name}`",
            c.type + (", may be null" if c.nullable else ""),
            c.unit,
            c.title,
            c.meaning + (" One of " + ", ".join(f"`{v}`" for v in c.values) + "." if c.values else ""),
        )
        for c in columns
    ]
    return markdown_table(("column", "type", "unit", "called", "meaning"), rows)


# --- formats and products -----------------------------------------------------------------------


def formats(_: str) -> str:
    """Overview of the formats and a section each."""
    found = _own(log_formats(), "roadscan.formats")
    overview = markdown_table(
        ("format", "what it is", "fills"),
        [
            (f"[`{n}`](#{n})", plain(f.title), ", ".join(f"[`{t}`](tables.md#{t})" for t in f.yields))
            for n, f in found.items()
        ],
    )
    return "\n\n".join([overview, *(_format_section(f) for f in found.values())])


def _format_section(kind: LogFormat) -> str:
    return "\n\n".join(
        [
            f"## {kind.name}",
            f"{sentence(kind.title)}",
            *manual(type(kind)),
            f"**Time.** {sentence(kind.time)}",
            *settings(kind.options),
        ]
    )


def sign_type_list(_: str) -> str:
    """Types of signs that the recogniser knows."""
    rows = (
        (" ".join(f"`{code}`" for code in one["codes"]), one["name"], one["shape"], ", ".join(one["colours"]))
        for one in listed_types()
    )
    return markdown_table(("code", "sign", "shape", "colours"), rows)


def known_file_list(_: str) -> str:
    """Files that are recognised and not read, with the way out of each."""
    rows = (
        (plain(one.words), ", ".join(f"`{e}`" for e in one.suffixes), markdown(one.way_out)) for one in known_files()
    )
    return markdown_table(("file", "names", "way out"), rows)


def product_list(_: str) -> str:
    """Overview of the products and a section each."""
    found = _own(products(), "roadscan.products")
    overview = markdown_table(
        ("product", "what it is", "files", "made"),
        [(f"[`{n}`](#{n})", plain(p.title), _files_words(p), _made_words(p)) for n, p in found.items()],
    )
    sections = (
        "\n\n".join([f"## {p.name}", sentence(p.title), *manual(type(p)), *settings(p.options)]) for p in found.values()
    )
    return "\n\n".join([overview, *sections])


def _made_words(product: Product) -> str:
    if not product.default:
        return "on request"
    if isinstance(product, SurfaceProduct):
        return "with `[surface]`"
    return {"any": "always", "fine": "cells below 2 cm", "coarse": "cells of 2 cm or more"}[product.default_cells]


def _files_words(product: Product) -> str:
    if isinstance(product, TileFiles):
        return f"`tiles/{product.name}/COLUMN_ROW{product.suffix}`"
    return f"`products/{product.name}/…`"


def settings(model: type[BaseModel]) -> list[str]:
    """Settings of a format or a product, and of the tables inside them."""
    if not model.model_fields:
        return ["It has no settings."]
    parts = ["Settings (`options`):", fields_table(model)]
    for name, info in model.model_fields.items():
        for inner in _models_in(info.annotation):
            parts += [f"Keys of `{name}`:", fields_table(inner)]
    return parts


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]


def manual(kind: type) -> list[str]:
    """What the docstrings of a class and of its module say beyond their first lines, as Markdown."""
    module = inspect.cleandoc(sys.modules[kind.__module__].__doc__ or "")
    whole = inspect.getdoc(kind) or ""
    parts = [module.partition("\n\n")[2], whole if "\n" in whole else ""]
    return [markdown(part) for part in parts if part.strip()]


def _own(found: dict[str, Any], group: str) -> dict[str, Any]:
    """Without what other installed packages add: the page is about this repository."""
    foreign = {entry.value for entry in entry_points(group=group)}
    return {n: one for n, one in found.items() if f"{type(one).__module__}:{type(one).__qualname__}" not in foreign}


# --- Markdown -----------------------------------------------------------------------------------


def include(name: str) -> str:
    """A file of ``docs/examples`` as a code block."""
    text = (DOCS / "examples" / name).read_text(encoding="utf-8").rstrip()
    language = {".py": "python", ".toml": "toml"}[Path(name).suffix]
    return f"```{language}\n{text}\n```"


def markdown_table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def one_line(text: str) -> str:
    """A docstring as one line."""
    return " ".join(text.split())


def sentence(text: str) -> str:
    """With a capital letter, unless it begins with a name, and a full stop."""
    first = text[:1].upper() if text.split(maxsplit=1)[0].isalpha() else text[:1]
    return first + plain(text[1:]) + ("" if text.endswith(".") else ".")


def plain(text: str) -> str:
    """Text whose angle brackets are not taken for HTML."""
    return text.replace("<", "\\<")


def markdown(text: str) -> str:
    """A docstring's reStructuredText as Markdown: code, roles and simple tables."""
    text = re.sub(r"^(=+ +[= ]*)\n(.*)\n\1\n((?:.*\n)+?)\1$", _simple_table, text.strip("\n"), flags=re.MULTILINE)
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"`\1`", text)
    return text.replace("``", "`")


def _simple_table(found: re.Match[str]) -> str:
    spans = [slice(m.start(), m.end()) for m in re.finditer("=+", found[1])]
    head, *body = (tuple(line[span].strip() for span in spans) for line in [found[2], *found[3].splitlines()])
    return markdown_table(head, body)


def _load(target: str) -> Any:
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)


def mistakes(_: str) -> str:
    """Mistakes, what roadscan prints of each when it is made, and what to do."""
    if (root := str(DOCS.parent)) not in sys.path:
        sys.path.insert(0, root)  # where this runs as a script
    from docs.mistakes import MISTAKES, heard

    rows = [
        (one.name, "<br>".join(f"`` {line.strip()} ``" for line in heard(one).text.splitlines()), one.remedy)
        for one in MISTAKES
    ]
    return markdown_table(("mistake", "what roadscan prints", "what to do"), rows)


_ACRONYM: Final = re.compile(r"\b(gnss|imu|nmea)\b")

_TOLD: Final = {"error": "an error", "rejects": "rejects", "findings": "a finding"}


def witness_list(_: str) -> str:
    """A section for each kind of input: what can be wrong, who is asked, what the run does, where it is told."""
    by_input: dict[str, list[Witness]] = {}
    for one in witnesses().values():
        by_input.setdefault(one.input, []).append(one)
    parts = []
    for kind, own in sorted(by_input.items()):
        title = _ACRONYM.sub(lambda found: found[0].upper(), kind)
        rows = [
            f"| `{w.name}` | {w.fault} | {w.asks} | {w.does} | {', '.join(_TOLD[t] for t in w.told)} |" for w in own
        ]
        head = [
            "| witness | what can be wrong | what is asked | what the run does | told as |",
            "|---|---|---|---|---|",
        ]
        parts.append("\n".join([f"## {title[0].upper()}{title[1:]}", "", *head, *rows]))
    return "\n\n".join(parts)


DIRECTIVES: Final[dict[str, Callable[[str], str]]] = {
    "witnesses": witness_list,
    "mistakes": mistakes,
    "fields": fields,
    "model": model,
    "members": members,
    "tables": tables,
    "packed_view": packed_view,
    "formats": formats,
    "known_files": known_file_list,
    "products": product_list,
    "include": include,
    "asset_columns": asset_columns,
    "asset_list": asset_list,
    "sign_types": sign_type_list,
    "distress_list": distress_list,
}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
