"""Configuration models: an unknown key is an error that names the nearest known one."""

from __future__ import annotations

import ast
import inspect
import textwrap
import tomllib
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Self, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from roadscan.model.errors import ConfigError, nearest


class Strict(BaseModel):
    """Base of every configuration model: frozen, no unknown keys, documented fields."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        validate_default=True,
        ser_json_inf_nan="constants",
    )

    @classmethod
    def parse(cls, values: dict[str, Any], *, file: str | Path | None = None) -> Self:
        """Validate `values`, or raise :class:`ConfigError` listing every fault."""
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            # A table where a path could stand too: only the table's own faults help.
            found = [f for f in error.errors() if f["type"] != "path_type" or not isinstance(f["input"], dict)]
            faults = [_describe(cls, fault) for fault in found]
            raise ConfigError("; ".join(faults), file=file) from error


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """The docstring under each field of a model, "" where there is none, in the order of the fields.

    Read from the source when asked for: pydantic would look for them in every process that starts, for a tenth of the
    time that all imports take.
    """
    found: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if issubclass(kind, BaseModel) and kind is not BaseModel:
            found |= _docstrings_of(kind)
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
"""Begins a line that waits for its author: `roadscan init` writes one for each thing it must not guess."""


def load_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file, or raise :class:`ConfigError` with the line of the fault.

    A line that begins with :data:`OPEN_QUESTION` is a fault: the file is not completed.
    """
    try:
        text = Path(path).read_bytes().decode("utf-8")
        values = tomllib.loads(text)
    except FileNotFoundError as error:
        raise ConfigError("the file does not exist", file=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
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


def _describe(model: type[BaseModel], fault: Any) -> str:
    where, current = _walk(model, fault["loc"])
    if fault["type"] == "extra_forbidden":
        known = list(current.model_fields) if current is not None else []
        key = str(fault["loc"][-1])
        return f"unknown key '{where}'{nearest(key, known)}, expected one of: {', '.join(sorted(known))}"
    if fault["type"] == "missing":
        return f"key '{where}' is missing"
    if fault["type"] in {"union_tag_not_found", "union_tag_invalid"}:
        return _untold(where, fault["ctx"])
    message = str(fault["msg"]).removeprefix("Value error, ")
    if not where:
        return message
    given = "" if isinstance(fault["input"], dict | list | BaseModel) else f" (got {fault['input']!r})"
    return f"'{where}'{given}: {message}"


def _untold(where: str, context: dict[str, str]) -> str:
    """Which of several tables is meant is not said by its key, or by a word that is none of theirs."""
    key = context["discriminator"].strip("'")
    if "tag" not in context:
        return f"key '{where}.{key}' is missing"
    known = [tag.strip().strip("'") for tag in context["expected_tags"].split(",")]
    tag = context["tag"]
    return f"'{where}.{key}' (got '{tag}'): unknown{nearest(tag, known)}, expected one of: {', '.join(known)}"


def _walk(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[str, type[BaseModel] | None]:
    """Keys of the file that lead to `location`, and the model that holds the last of them."""
    names: list[str] = []
    holder: type[BaseModel] | None = None
    annotation: Any = model
    for part in location:
        annotation, choices = _without_none(annotation)
        if choices:  # pydantic names the member of a union, which the file does not
            annotation = next((c for c in choices if _is_called(c, part)), None)
            continue
        names.append(str(part))
        holder = annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None
        if holder is not None:
            field = holder.model_fields.get(str(part))
            annotation = None if field is None else field.annotation
        else:  # a dictionary's key or a list's index
            arguments = get_args(annotation)
            position = 1 if get_origin(annotation) is dict else 0
            annotation = arguments[position] if len(arguments) > position else None
    return ".".join(names), holder


def _is_called(member: Any, name: int | str) -> bool:
    """Whether pydantic calls a member of a union so: by its class, or by the word that tells the members apart."""
    if getattr(member, "__name__", "") == name:
        return True
    fields = getattr(member, "model_fields", {}).values()
    return any(get_origin(f.annotation) is Literal and get_args(f.annotation) == (name,) for f in fields)


def _without_none(annotation: Any) -> tuple[Any, tuple[Any, ...]]:
    """The annotation without `None`, and its members where it is still a union."""
    if get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) not in {Union, UnionType}:
        return annotation, ()
    members = tuple(a for a in get_args(annotation) if a is not NoneType)
    return (members[0], ()) if len(members) == 1 else (annotation, members)
