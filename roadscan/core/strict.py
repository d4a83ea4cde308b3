"""Base class of configuration models: an unknown key is an error that names the nearest known one."""

from __future__ import annotations

import ast
import datetime as dt
import inspect
import re
import textwrap
import tomllib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Final, Literal, Self, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from roadscan.core.errors import ConfigError, in_words, nearest


class Strict(BaseModel):
    """Base of every configuration model: frozen, no unknown keys, documented fields."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        validate_default=True,
        allow_inf_nan=False,
        ser_json_inf_nan="constants",
    )

    later: ClassVar[frozenset[str]] = frozenset()
    """Fields added after stores existed: they are left out of keys while they have their default."""

    def shaping(self) -> dict[str, Any]:
        """Return the JSON values of the settings, for keys: without `later` fields that have their default."""
        unset = {name for name in self.later if getattr(self, name) == type(self).model_fields[name].default}
        return self.model_dump(mode="json", exclude=unset)

    @classmethod
    def parse(cls, values: dict[str, Any], *, file: str | Path | None = None) -> Self:
        """Validate `values`, or raise :class:`ConfigError` listing every fault."""
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise ConfigError("; ".join(faults_in_words(cls, values, error)), file=file) from error


MEANINGS: Final[dict[type[BaseModel], dict[str, str]]] = {}
"""Field descriptions of models that are created at run time and have no source."""


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field of a model in the order of the fields, "" where there is none.

    Read from the source when asked for: pydantic would look for them in every process that starts, for a tenth of the
    time that all imports take.
    """
    found: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if issubclass(kind, BaseModel) and kind is not BaseModel:
            found |= MEANINGS[kind] if kind in MEANINGS else _docstrings_of(kind)
    return {name: found.get(name, "") for name in model.model_fields}


def _docstrings_of(kind: type) -> dict[str, str]:
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    found = {}
    for field, text in pairwise(definition.body if isinstance(definition, ast.ClassDef) else ()):
        match field, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                found[name] = inspect.cleandoc(words)
    return found


OPEN_QUESTION: Final = "#?"
"""Starts a line that the user has to complete: `roadscan init` writes one for each thing it must not guess."""


def load_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file, or raise :class:`ConfigError` with the line of the fault.

    A line that begins with :data:`OPEN_QUESTION` is a fault: the file is not completed.
    """
    try:
        content = Path(path).read_bytes()
        if b"\0" in content:
            raise ConfigError(
                "the file is no text",
                expected="a file in TOML, such as the SURVEY.toml that `roadscan init` writes",
                change="see what it holds with `roadscan inspect`",
                file=path,
            )
        text = content.decode("utf-8")
        values = tomllib.loads(text)
    except FileNotFoundError as error:
        raise ConfigError("the file does not exist", file=path) from error
    except IsADirectoryError as error:
        raise ConfigError("this is a folder", expected="a file (TOML)", file=path) from error
    except OSError as error:
        reason = in_words(error)
        raise ConfigError(f"the file cannot be read: {reason.arrived}", change=reason.change, file=path) from error
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ConfigError(
            f"not valid TOML: line {line} holds a byte that is no text in UTF-8", change="save it as UTF-8", file=path
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not valid TOML: {error}", file=path) from error
    _refuse_open_questions(text, path)
    return values


def _refuse_open_questions(text: str, path: str | Path) -> None:
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), 1)]
    questions = [(n, line) for n, line in lines if line.startswith(OPEN_QUESTION)]
    if questions:
        number, line = questions[0]
        raise ConfigError(
            f"line {number} is not completed ({len(questions)} open in all): "
            f"{line.removeprefix(OPEN_QUESTION).strip()}",
            expected=f"the line completed, and its '{OPEN_QUESTION}' taken away",
            file=path,
        )


def faults_in_words(model: type[BaseModel], values: Any, error: ValidationError) -> list[str]:
    """Return every fault of a validation in words, one for each key: where, what stands there, what is expected."""
    faults = error.errors(include_url=False)
    by_place: dict[tuple[str, str], list[str]] = {}  # a value that fits no member of a union has one for each member
    for fault in faults:
        if _is_beside(fault, faults):
            continue
        place, holder = _walk(model, fault["loc"][:-1] if _is_too_short(fault) else fault["loc"])
        if fault["type"] in _OF_TAGS:
            place.append(fault["ctx"]["discriminator"].strip("'"))
        where = _place(place, values)
        by_place.setdefault((where, _got(fault)), []).append(_expected(fault, holder, where))
    return [_sentence(where, got, expected) for (where, got), expected in by_place.items()]


def _is_too_short(fault: Any) -> bool:
    """Return whether a list of fixed length is too short."""
    return fault["type"] == "missing" and isinstance(fault["loc"][-1], int)


def _is_beside(fault: Any, faults: Sequence[Any]) -> bool:
    """Return whether a fault is implied by another one: a table's faults, or the last missing item, say more."""
    above = fault["loc"][:-1]
    if _is_too_short(fault):
        return any(_is_too_short(f) and f["loc"][:-1] == above and f["loc"][-1] > fault["loc"][-1] for f in faults)
    others = (f for f in faults if f is not fault and f["loc"][: len(above)] == above)
    return isinstance(fault["input"], dict) and fault["type"] not in _OF_TABLES and any(others)


def _got(fault: Any) -> str:
    if fault["type"] == "union_tag_invalid":
        return f" (got '{fault['ctx']['tag']}')"
    if fault["type"] in _WITHOUT_VALUE or isinstance(fault["input"], dict | list | tuple | BaseModel):
        return ""
    return f" (got {_toml_value(fault['input'])})"


def _toml_value(value: Any) -> str:
    """Return a value as it is written in the file."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dt.date | dt.time):
        return value.isoformat()
    return repr(str(value)) if isinstance(value, str | Path) else str(value)


def _sentence(where: str, got: str, expected: list[str]) -> str:
    distinct = list(dict.fromkeys(expected))
    choices = [one.removeprefix(_EXPECTED) for one in distinct if one.startswith(_EXPECTED)]
    rest = [one for one in distinct if not one.startswith(_EXPECTED)]
    said = "; ".join([*rest, *([_EXPECTED + " or ".join(choices)] if choices else [])])
    if any(one.startswith(("unknown key ", "key ")) for one in rest) or not where:
        return said
    return f"{where}{got}: {said}"


_EXPECTED: Final = "expected "
_OF_TAGS: Final = frozenset({"union_tag_not_found", "union_tag_invalid"})
_OF_TABLES: Final = _OF_TAGS | {"extra_forbidden", "missing"}
_WITHOUT_VALUE: Final = _OF_TABLES | {"value_error"}

_NUMBER, _WHOLE, _TABLE, _LIST = (
    "a number",
    "a whole number",
    "a table, such as {{ key = value }}",
    "a list, such as [ … ]",
)
_DATE, _INSTANT = "a date, such as 2026-05-04", "a date and time with its zone, such as 2026-05-04T09:30:00Z"

_WORDS: Final[dict[str, str]] = {
    "greater_than": "a number above {gt:g}", "greater_than_equal": "{ge:g} or more",
    "less_than": "a number below {lt:g}", "less_than_equal": "{le:g} or less",
    "multiple_of": "a multiple of {multiple_of:g}", "finite_number": "a finite number",
    "float_type": _NUMBER, "float_parsing": _NUMBER,
    "int_type": _WHOLE, "int_parsing": _WHOLE, "int_from_float": _WHOLE, "int_parsing_size": _WHOLE + " of usual size",
    "bool_type": "true or false", "bool_parsing": "true or false",
    "string_type": "a text in quotes", "string_unicode": "a text in UTF-8", "path_type": "a path in quotes",
    "string_too_short": "a text of {min_length} letters or more",
    "string_too_long": "a text of {max_length} letters or less",
    "list_type": _LIST, "tuple_type": _LIST, "iterable_type": _LIST, "set_type": _LIST,
    "too_short": "a list of at least {min_length} ({actual_length} given)",
    "too_long": "a list of at most {max_length} ({actual_length} given)",
    "dict_type": _TABLE, "mapping_type": _TABLE, "model_type": _TABLE, "model_attributes_type": _TABLE,
    "invalid_key": "keys that are text",
    "date_type": _DATE, "date_parsing": _DATE, "date_from_datetime_parsing": _DATE, "date_from_datetime_inexact": _DATE,
    "datetime_type": _INSTANT, "datetime_parsing": _INSTANT, "datetime_object_invalid": _INSTANT,
    "datetime_from_date_parsing": _INSTANT, "timezone_naive": _INSTANT, "timezone_aware": _INSTANT,
    "none_required": "nothing: leave the key out",
}  # fmt: skip
"""Expected value in words, by the kind of a pydantic fault."""

NAME_PATTERN: Final = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
"""Pattern of valid ids."""
_PATTERNS: Final[dict[str, str]] = {
    NAME_PATTERN: "1 to 64 letters (A–Z, a–z), digits, '_', '-' or '.', of which the first is a letter or a digit",
}


def pattern_in_words(pattern: str, words: str) -> str:
    """Return the pattern, and register the words that describe it in errors."""
    _PATTERNS[pattern] = words
    return pattern


def _expected(fault: Any, holder: type[BaseModel] | None, where: str) -> str:
    """Return the expected value of a fault as a part of a sentence."""
    kind, context = str(fault["type"]), fault.get("ctx", {})
    match kind:
        case "extra_forbidden":
            known = list(holder.model_fields) if holder is not None else []
            return f"unknown key {where}{nearest(str(fault['loc'][-1]), known)}, expected one of: " + ", ".join(
                sorted(known)
            )
        case "missing" if _is_too_short(fault):
            return f"{_EXPECTED}a list of {fault['loc'][-1] + 1} ({len(fault['input'])} given)"
        case "missing" | "union_tag_not_found":
            return f"key {where} is missing"
        case "union_tag_invalid":
            tags = [tag.strip().strip("'") for tag in context["expected_tags"].split(",")]
            return f"unknown{nearest(context['tag'], tags)}, expected one of: {', '.join(tags)}"
        case "literal_error" | "enum":
            choices = [one.strip("'") for one in re.findall(r"'[^']*'|-?\d+", str(context["expected"]))]
            return f"{_EXPECTED}one of: {', '.join(choices)}{nearest(str(fault['input']), choices)}"
        case "string_pattern_mismatch":
            return _EXPECTED + _PATTERNS.get(context["pattern"], "a text of another form")
        case "value_error" | "assertion_error":
            return str(context["error"])
    return _EXPECTED + _WORDS.get(kind, "another kind of value").format(**context)


_ENTRIES: Final = {"logs": "log", "runs": "run", "passes": "pass", "control": "control log"}
_LABELS: Final = ("path", "id", "sensor")


def _place(location: Sequence[int | str], values: Any) -> str:
    """Return the place in the file: a key, with the log (by path), run or pass to which it belongs."""
    label, rest, value = "", list(location), values
    for depth, part in enumerate(location):
        value = _inside(value, part)
        entry = _ENTRIES.get(str(location[depth - 1])) if depth and isinstance(part, int) else None
        if entry is not None:
            label = _label(entry, value) or f"number {int(part) + 1} of {location[depth - 1]}"
            rest = list(location[depth + 1 :])
    if not label:
        return f"'{'.'.join(map(str, location))}'" if location else ""
    return f"'{'.'.join(map(str, rest))}' of {label}" if rest else label


def _label(entry: str, value: Any) -> str:
    """Return the name of a log, run or pass in the file; "" where it has none."""
    name = next((value[key] for key in _LABELS if key in value), None) if isinstance(value, dict) else None
    return f"{entry} '{name}'" if isinstance(name, str) else f"{entry} {name}" if isinstance(name, int) else ""


def _inside(value: Any, part: int | str) -> Any:
    if isinstance(value, dict):
        return value.get(part)
    return value[part] if isinstance(value, list) and isinstance(part, int) and part < len(value) else None


def _walk(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[list[int | str], type[BaseModel] | None]:
    """Return the keys of the file that lead to `location`, and the model that contains the last of them."""
    place: list[int | str] = []
    holder: type[BaseModel] | None = None
    annotation: Any = model
    for part in location:
        annotation, choices = _without_none(annotation)
        if choices:  # pydantic names the member of a union, which is no key of the file
            annotation = next((c for c in choices if _is_called(c, part)), None)
            continue
        if part == "[key]":
            continue
        place.append(part)
        holder = annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None
        if holder is not None:
            field = holder.model_fields.get(str(part))
            annotation = None if field is None else field.annotation
        else:  # a dictionary's key or a list's index
            arguments = get_args(annotation)
            position = 1 if get_origin(annotation) is dict else 0
            annotation = arguments[position] if len(arguments) > position else None
    return place, holder


def _is_called(member: Any, name: int | str) -> bool:
    """Return whether pydantic names a union member so: by its class, or by its discriminator."""
    if getattr(member, "__name__", "") == name:
        return True
    fields = getattr(member, "model_fields", {}).values()
    return any(get_origin(f.annotation) is Literal and get_args(f.annotation) == (name,) for f in fields)


def _without_none(annotation: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the annotation without `None`, and its members where it is still a union."""
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) not in {Union, UnionType}:
        return annotation, ()
    members = tuple(a for a in get_args(annotation) if a is not NoneType)
    return (members[0], ()) if len(members) == 1 else (annotation, members)
