"""A fleet's template: a TOML file that answers what `roadscan init` asks, for each survey of its vehicles."""

from __future__ import annotations

import copy
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from roadscan.core.errors import ConfigError
from roadscan.core.rig import Rig
from roadscan.core.strict import Strict, load_toml
from roadscan.core.survey import Survey
from roadscan.core.toml_text import toml, toml_key
from roadscan.ingest.inspect.first_survey import FoundFolder, FoundLog, FoundRun, find_logs, weeks_of_overlap
from roadscan.ingest.inspect.first_survey_text import RIG_NAME, survey_lines

SURVEY_NAME: Final = "SURVEY.toml"
"""Name of the survey file that is written."""
BY_OVERLAP: Final = "overlap"
"""As the `week` of a clock: the GPS week in which the log overlaps with those logs of its run whose time is known."""


class FleetTemplate(Strict):
    """What is the same for every survey of a fleet; a template serves the vehicles that share a rig file."""

    rig: Path
    """Rig file of the vehicles, relative to the template. It is copied beside each survey file."""
    survey: dict[str, Any] = Field(default_factory=dict)
    """Settings that each survey file takes, as they stand in it: `survey.map`, `survey.products`, `survey.store` …"""
    logs: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Settings of logs, by the name of their sensor or of their format; those of the sensor go before. In a `clock`,
    `week = "overlap"` takes the GPS week in which the log overlaps with the logs of its run whose time is known."""
    manifest: str = "MANIFEST.csv"
    """Name of the list of files in a folder that arrives: columns `name`, `bytes`, and `sha256` (not required)."""
    quiet_min: float = Field(default=10.0, ge=0.0)
    """A folder without a manifest is complete when nothing in it changed for this time (minutes). One that has a
    manifest and is not complete after this time is refused."""
    queues: dict[str, str] = Field(default_factory=dict)
    """Work queue of Prefect by the pattern of a folder's name, such as `"urgent-*" = "urgent"`; the first that fits."""
    site: bool = True
    """Whether the survey is published as a page, in the folder `site` beside the survey file."""

    @classmethod
    def load(cls, file: Path) -> FleetTemplate:
        """Read a template.

        Raises
        ------
        ConfigError
            where it is no such file; all faults are listed.
        """
        read = cls.parse(load_toml(file), file=file)
        return read.model_copy(update={"rig": file.resolve().parent / read.rig})


def write_survey(template: FleetTemplate, logs: Path, home: Path, survey_id: str) -> Path:
    """Write the survey file of a folder of raw logs, and the rig file beside it; return the survey file.

    One that is there already stays as it is: a person may have changed it.

    Raises
    ------
    ConfigError
        where no log is known, or the template leaves a question of `roadscan init` open; all open ones are listed.
    """
    file = home / SURVEY_NAME
    if file.exists():
        return file
    found = find_logs(logs)
    if not found.runs:
        raise ConfigError("no log that roadscan can read was found", expected="a log of a known format", file=logs)
    home.mkdir(parents=True, exist_ok=True)
    values = _answered(template, found, home)
    values["id"] = survey_id
    draft = home / f".{SURVEY_NAME}"
    draft.write_text("\n".join(_lines(values)) + "\n", encoding="utf-8")
    try:
        shutil.copyfile(template.rig, home / RIG_NAME)
        Survey.load(draft)
        draft.replace(file)
    finally:
        draft.unlink(missing_ok=True)
    return file


def _answered(template: FleetTemplate, found: FoundFolder, home: Path) -> dict[str, Any]:
    """Return the values of the first survey file, with the template's answers laid over them."""
    values = tomllib.loads("\n".join(survey_lines(found, home.resolve())))
    values["rig"] = RIG_NAME
    values = _laid_over(values, template.survey)
    pairs: list[tuple[dict[str, Any], FoundLog, FoundRun | None]] = [
        (written, log, run)
        for run, table in zip(found.runs, values["runs"], strict=True)
        for log, written in zip(run.logs, table["logs"], strict=True)
    ]
    pairs += [(table, log, None) for log, table in zip(found.control, values.get("control", ()), strict=True)]
    open_ones: list[str] = []
    for written, log, run in pairs:
        answers = _laid_over(template.logs.get(log.format.name, {}), template.logs.get(log.sensor, {}))
        written.update(_laid_over(written, _with_week(answers, log, run)))
        place = f"{log.path.relative_to(found.folder)} ({log.format.name})"
        open_ones += [f"{need.key} of {place}" for need in log.needs if not _states(written, need.key)]
    known = set(Rig.load(template.rig).sensors)
    open_ones += [f"sensor '{name}', which the rig file does not hold" for name in found.sensors if name not in known]
    if not {"crs", "local"} & set(values.get("map", {})):
        open_ones.append("crs of the map")
    if open_ones:
        raise ConfigError(
            f"the fleet's template leaves open: {'; '.join(open_ones)}",
            change="state them below [logs.NAME] of the template (NAME: the format or the sensor), [survey.map], or in "
            "its rig file",
            file=found.folder,
        )
    return values


def _with_week(answers: dict[str, Any], log: FoundLog, run: FoundRun | None) -> dict[str, Any]:
    """Return the answers, with the GPS week of a clock that is to be taken from the run's other logs."""
    clock = answers.get("clock")
    if not isinstance(clock, dict) or clock.get("week") != BY_OVERLAP:
        return answers
    weeks = set() if run is None else weeks_of_overlap(log, run)
    if len(weeks) != 1:
        met = f"logs of {len(weeks)} weeks overlap with it" if weeks else "no log whose time is known overlaps with it"
        raise ConfigError(f'week = "{BY_OVERLAP}" does not tell the week: {met}', expected="one week", file=log.path)
    return answers | {"clock": clock | {"week": weeks.pop()}}


def _states(written: Mapping[str, Any], key: str) -> bool:
    """Return whether a log states a setting, such as `crs` or `options.topic`."""
    value: Any = written
    for part in key.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return False
        value = value[part]
    return True


def _laid_over(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return the first table with the second laid over it, tables in them too."""
    both = copy.deepcopy(dict(under))
    for key, value in over.items():
        old = both.get(key)
        both[key] = _laid_over(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return both


def _lines(values: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Yield a table as TOML: values first, then tables and lists of tables, each below a header."""
    nested = {k: v for k, v in values.items() if isinstance(v, dict) or _is_list_of_tables(v)}
    yield from (f"{toml_key(k)} = {toml(v)}" for k, v in values.items() if k not in nested)
    for key, value in nested.items():
        name = f"{above}{toml_key(key)}"
        if isinstance(value, dict):
            yield from ("", f"[{name}]", *_lines(value, f"{name}."))
            continue
        for one in value:
            yield from ("", f"[[{name}]]", *_lines(one, f"{name}."))


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, dict) for one in value)
