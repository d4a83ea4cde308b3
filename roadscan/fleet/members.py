"""Finds the surveys of a folder or bucket: survey files, and stores without one."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.survey import Survey
from roadscan.navigation.tasks.navigate import known_keys
from roadscan.store.query.sql_fleet import Member
from roadscan.store.store import Store, opened_url

_DEPTH: Final = 3
"""Levels of folders in which survey files and stores are looked for: a large tree of raw logs is not."""
_MARK: Final = "survey="
"""How the folder of a survey begins in its store."""


@dataclass(frozen=True)
class Found:
    """A survey of a fleet."""

    store: Store | None
    """None where its survey file cannot be read."""
    file: str = ""
    """Its survey file, relative to the fleet's folder; empty where there is none."""
    survey: Survey | None = None
    fault: str = ""
    """Why its survey file cannot be read."""

    @property
    def id(self) -> str:
        """Its id; that of a survey file that cannot be read is the file's name."""
        return self.file if self.store is None else self.store.survey_id

    def member(self) -> Member:
        """Return it as a statement reaches it: with the logs that its survey file lists."""
        if self.store is None:
            raise ConfigError(self.fault, file=self.file)
        if self.survey is None:
            return Member(self.store, None)
        return Member(self.store, frozenset(known_keys(self.survey, self.store)))


def surveys_in(place: str) -> list[Found]:
    """Return the surveys of a folder (a path, or the URL of an object store) by their ids.

    Raises
    ------
    ConfigError
        There is no such folder.
    """
    fs, base = opened_url(place)
    local = Path(place) if "://" not in place else None
    if local is not None and not local.is_dir():
        raise ConfigError("there is no such folder", expected="a folder or bucket with surveys", file=place)
    found = [] if local is None else [_of_file(local, file) for file in _survey_files(local)]
    known = {one.store.root for one in found if one.store is not None}
    for folder in _stores(fs, base):
        parent, _, name = folder.rpartition("/")
        url = parent if local is not None else fs.unstrip_protocol(parent)
        store = Store(url, name.removeprefix(_MARK))
        if store.root not in known:
            known.add(store.root)
            found.append(Found(store))
    return sorted(found, key=lambda one: (one.id, one.file))


def _survey_files(folder: Path) -> Iterator[Path]:
    for depth in range(_DEPTH):
        for file in sorted(folder.glob("*/" * depth + "*.toml")):
            if _MARK not in str(file.relative_to(folder)) and _is_survey(file):
                yield file


def _is_survey(file: Path) -> bool:
    """Return whether a TOML file says that it is a survey's: one that is damaged further down still counts."""
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    try:
        values = tomllib.loads(text)
    except ValueError:
        return "[[runs]]" in text and "[map]" in text
    return isinstance(values.get("runs"), list) and "map" in values


def _of_file(folder: Path, file: Path) -> Found:
    name = file.relative_to(folder).as_posix()
    try:
        survey = Survey.load(file)
        return Found(Store(survey.store_url, survey.config.id), name, survey)
    except RoadscanError as error:
        return Found(None, name, fault=str(error))


def _stores(fs: Any, base: str) -> Iterator[str]:
    """Yield the folders of surveys in stores."""
    for depth in range(_DEPTH):
        yield from sorted(str(one).rstrip("/") for one in fs.glob(f"{base.rstrip('/')}/{'*/' * depth}{_MARK}*"))
