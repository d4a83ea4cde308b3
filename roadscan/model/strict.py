"""Configuration models: an unknown key is an error that names the nearest known one."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from roadscan.model.errors import ConfigError, nearest


class Strict(BaseModel):
    """Base of every configuration model: frozen, no unknown keys, documented fields."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, validate_default=True)

    @classmethod
    def parse(cls, values: dict[str, Any], *, file: str | Path | None = None) -> Self:
        """Validate `values`, or raise :class:`ConfigError` listing every fault."""
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            faults = [_describe(cls, fault) for fault in error.errors()]
            raise ConfigError("; ".join(faults), file=file) from error


def load_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file, or raise :class:`ConfigError` with the line of the fault."""
    try:
        with Path(path).open("rb") as stream:
            return tomllib.load(stream)
    except FileNotFoundError as error:
        raise ConfigError("the file does not exist", file=path) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not valid TOML: {error}", file=path) from error


def _describe(model: type[BaseModel], fault: Any) -> str:
    where = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        known = _fields_at(model, fault["loc"][:-1])
        key = str(fault["loc"][-1])
        return f"unknown key '{where}'{nearest(key, known)}, expected one of: {', '.join(sorted(known))}"
    if fault["type"] == "missing":
        return f"key '{where}' is missing"
    given = "" if isinstance(fault["input"], dict | list) else f" (got {fault['input']!r})"
    message = str(fault["msg"]).removeprefix("Value error, ")
    return f"'{where}'{given}: {message}"


def _fields_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Names of the fields of the model that stands at `location` inside `model`."""
    current: type[BaseModel] = model
    for part in location:
        field = current.model_fields.get(str(part))
        if field is None:
            continue  # a list index or a dictionary key
        inner = _model_in(field.annotation)
        if inner is None:
            return []
        current = inner
    return list(current.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None
