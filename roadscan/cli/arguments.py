"""Arguments that several commands share, and what a shell completes them with."""

from __future__ import annotations

import functools
import inspect
import textwrap
import tomllib
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Final, get_type_hints

import typer

USUAL: Final = "SURVEY.toml"
"""Name of the survey file that every command looks for in the current folder."""
_HELP_WIDTH: Final = 60
"""Shells show longer explanations on several lines, of which fish makes words of their own."""


def _none() -> None:
    return None


def _or_found(context: typer.Context, named: Path | None) -> Path | None:
    """The file that was named, or the one that is found; while a shell completes words, nothing is looked for."""
    return named if named is not None or context.resilient_parsing else found_survey()


def found_survey() -> Path:
    """The survey file of the current folder: ``SURVEY.toml``, or the only other one.

    Raises
    ------
    ConfigError
        There is none, or there are several.
    """
    from roadscan.core.errors import ConfigError

    usual = Path(USUAL)
    if usual.is_file():
        return usual
    others = [file for file in sorted(Path().glob("*.toml")) if _is_survey(file)]
    if len(others) == 1:
        return others[0]
    if others:
        raise ConfigError(
            f"no survey file was named, and there are several here: {', '.join(map(str, others))}",
            expected=f"one of them, or {USUAL}",
            change="name the one you mean",
            file=Path().resolve(),
        )
    raise ConfigError(
        f"no survey file was named, and there is no {USUAL} here",
        expected="a survey file",
        change="name it, go to its folder, or write a first one with `roadscan init FOLDER`",
        file=Path().resolve(),
    )


def _is_survey(file: Path) -> bool:
    """Whether a TOML file has what only a survey file has."""
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(values.get("runs"), list) and "map" in values


def span_gps_ns(span: str) -> tuple[int, int]:
    """First and last GPS time of ``START/END``, two times with a zone.

    Raises
    ------
    ConfigError
        It is not two times.
    TimeSystemError
        One has no zone.
    """
    import datetime as dt

    from roadscan.core.errors import ConfigError
    from roadscan.core.gpstime import gps_ns_from_utc

    try:
        start, end = (dt.datetime.fromisoformat(part) for part in span.split("/"))
    except ValueError:
        raise ConfigError(f"--span {span}", expected="START/END, such as 2026-05-04T09:30:00Z/…") from None
    return gps_ns_from_utc(start), gps_ns_from_utc(end)


def surveys_for(incomplete: str) -> list[str]:
    """TOML files whose names begin so; without any, the shell completes files in its own way."""
    folder, _, begun = incomplete.rpartition("/")
    place = Path(f"{folder}/") if "/" in incomplete else Path()
    if not place.is_dir():
        return []
    names = sorted(file.name for file in place.glob("*.toml") if file.name.startswith(begun))
    return [f"{folder}/{name}" if "/" in incomplete else name for name in names]


def formats_for(incomplete: str) -> list[tuple[str, str]]:
    """Names of formats, with what they are."""
    from roadscan.ingest.reading.format import log_formats

    return [
        (name, textwrap.shorten(one.title, _HELP_WIDTH, placeholder="…"))
        for name, one in log_formats().items()
        if name.startswith(incomplete)
    ]


def scenes_for(incomplete: str) -> list[str]:
    """Names of shipped scenes, and scene files."""
    from roadscan.simulate.scene import shipped_scenes

    return [name for name in shipped_scenes() if name.startswith(incomplete)] + surveys_for(incomplete)


SurveyFile = Annotated[
    Path,
    typer.Argument(
        metavar=USUAL,
        help="The survey file; the current folder's where it is left out.",
        show_default=False,
        default_factory=_none,
        callback=_or_found,
        autocompletion=surveys_for,
    ),
]
SurveyOption = Annotated[
    Path,
    typer.Option(
        "--survey",
        help="The survey file; the current folder's where it is left out.",
        show_default=False,
        default_factory=_none,
        callback=_or_found,
        autocompletion=surveys_for,
    ),
]
SurveyOrFleet = Annotated[
    Path | None,
    typer.Option(
        "--survey",
        help="The survey file; the current folder's where it is left out.",
        show_default=False,
        autocompletion=surveys_for,
    ),
]
Workers = Annotated[
    int | None, typer.Option(help="Worker processes of the embedded cluster; 0 computes in this process.")
]
Scheduler = Annotated[str | None, typer.Option(help="Address of a Dask scheduler, in place of the embedded cluster.")]
Dashboard = Annotated[
    bool,
    typer.Option(
        "--dashboard",
        help="Serve Dask's dashboard of the embedded cluster; every user of this machine can look at it.",
    ),
]
PlainJson = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object, and nothing else.")]


def options_apart(command: Callable[..., None]) -> Callable[..., None]:
    """The command as it is called from a shell: each field of its dataclasses is an option of its own."""
    hints = get_type_hints(command, include_extras=True)
    structures = {name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)}
    options: dict[str, inspect.Parameter] = {}
    for name, parameter in inspect.signature(command).parameters.items():
        if name not in structures:
            options[name] = parameter.replace(annotation=hints[name])
            continue
        kinds = get_type_hints(structures[name], include_extras=True)
        for field in fields(structures[name]):
            default = parameter.empty if field.default is MISSING else field.default
            options[field.name] = parameter.replace(name=field.name, annotation=kinds[field.name], default=default)

    @functools.wraps(command)
    def called(**given: Any) -> None:
        held = {name: kind(**{f.name: given.pop(f.name) for f in fields(kind)}) for name, kind in structures.items()}
        command(**given, **held)

    called.__signature__ = inspect.Signature(list(options.values()))  # type: ignore[attr-defined]
    called.__annotations__ = {name: option.annotation for name, option in options.items()}
    return called
