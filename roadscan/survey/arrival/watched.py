"""Folders that arrive below a watched folder or bucket: complete, still coming, or refused with a reason."""

from __future__ import annotations

import contextlib
import copy
import csv
import hashlib
import io
import re
import shutil
import tomllib
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal

import fsspec
from fsspec.implementations.local import LocalFileSystem
from pydantic import Field

from roadscan.core.errors import ChangingLogError, ConfigError, StoreError
from roadscan.core.rig import Rig
from roadscan.core.strict import Strict, load_toml
from roadscan.core.survey import Survey
from roadscan.core.toml_text import toml, toml_key
from roadscan.ingest.inspect.diagnosis import formats_of
from roadscan.ingest.inspect.first_survey import (
    FoundFolder,
    FoundLog,
    FoundRun,
    candidates,
    find_logs,
    weeks_of_overlap,
)
from roadscan.ingest.inspect.first_survey_text import RIG_NAME, survey_lines
from roadscan.store.digest import checked_json, parse_checked
from roadscan.store.stamp import Stamp, stamp_of_info

RECORDS: Final = ".arrivals"
"""Folder of the records below the folder of surveys: one file a folder that was seen."""
_SOUND: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
"""Names that a survey's id can have."""
_TOLD: Final = 5
"""Most files that a reason names."""

State = Literal["coming", "refused", "started"]


@dataclass(frozen=True)
class Record:
    """What is known of a folder; the file of it is all that a watch remembers."""

    state: State
    listing: str
    """Digest of names, sizes and times of all files."""
    since_s: float
    """When this listing was first seen, by the clock of who watches (seconds since 1970)."""
    reason: str = ""
    """Why it was refused, or what changed since it was started."""


@dataclass(frozen=True)
class Listing:
    """The files of a folder by name: size and a mark that changes with the content."""

    files: Mapping[str, Stamp]

    @property
    def digest(self) -> str:
        """Digest of the whole listing."""
        return hashlib.sha256(repr(sorted(self.files.items())).encode()).hexdigest()


class Watched:
    """A folder or bucket of which each folder is to become a survey.

    Parameters
    ----------
    url : path or URL of it, as fsspec opens it.
    surveys : folder of surveys, which keeps the records.
    """

    def __init__(self, url: str, surveys: Path) -> None:
        self.fs, self.root = fsspec.url_to_fs(url, skip_instance_cache=True)
        self.is_local = isinstance(self.fs, LocalFileSystem)
        self.surveys = surveys

    def names(self) -> list[str]:
        """Return the folders; StoreError where the place does not answer, or no such folder or bucket is there."""
        self.fs.invalidate_cache()
        with self._answering():
            try:
                found = self.fs.ls(self.root, detail=True)
            except FileNotFoundError:  # below a bucket, a folder is there as soon as something lies in it
                if self.is_local or not self.fs.exists(self.root.partition("/")[0]):
                    raise
                found = []
        names = (PurePosixPath(one["name"]).name for one in found if one["type"] == "directory")
        return sorted(name for name in names if not name.startswith("."))

    def listing(self, name: str) -> Listing:
        """Return the files of a folder; hidden ones are left out."""
        self.fs.invalidate_cache()
        top = f"{self.root}/{name}/"
        with self._answering():
            found = self.fs.find(top, detail=True)
        files = {path.removeprefix(top): stamp_of_info(info) for path, info in found.items()}
        return Listing({n: v for n, v in files.items() if not any(p.startswith(".") for p in n.split("/")) and n})

    def look(self, name: str, template: FleetTemplate, now_s: float) -> tuple[Record, bool]:
        """Return what is known of a folder now, and whether it is new.

        A folder to be started is returned as `started`; who starts it calls :meth:`keep` afterwards.
        """
        old, listing = self.record(name), self.listing(name)
        same = old is not None and old.listing == listing.digest
        if old is not None and old.state == "started":
            if same or old.reason:
                return old, False
            return replace(old, reason="its files changed after it had arrived; they are not looked at again"), True
        if old is not None and same and old.state == "refused":
            return old, False
        since_s = old.since_s if old is not None and same else now_s
        quiet = now_s - since_s >= template.quiet_min * 60.0
        reason = self._lacks(name, listing, template)
        if reason != "" and not quiet:
            return Record("coming", listing.digest, since_s), not same
        reason = reason or self._unfit(name)
        return Record("refused" if reason else "started", listing.digest, since_s, reason), True

    def _lacks(self, name: str, listing: Listing, template: FleetTemplate) -> str | None:
        """Return what is not there by the manifest, "" if all is; None where there is no manifest."""
        if not listing.files:
            return "it holds no file"
        if template.manifest not in listing.files:
            return None
        try:
            wanted = self.manifest(name, template)
        except ConfigError as error:
            return str(error)
        sizes = {file: size for file, (size, _) in listing.files.items()}
        lacking = [
            f"{file} ({'not there' if file not in sizes else f'{sizes[file]:,} of {size:,} bytes'})"
            for file, (size, _) in wanted.items()
            if sizes.get(file) != size
        ]
        more = f" and {len(lacking) - _TOLD:,} more" if len(lacking) > _TOLD else ""
        return f"incomplete by {template.manifest}: {', '.join(lacking[:_TOLD])}{more}" if lacking else ""

    def _unfit(self, name: str) -> str:
        """Return why no survey can be made of a complete folder; "" where nothing is known against it."""
        if not _SOUND.fullmatch(name):
            return "its name cannot be a survey's id: letters, digits, _ . - and at most 64 of them"
        if self.is_local and not any(formats_of(one) for one in candidates(Path(self.root) / name)):
            return "no log of a format that `roadscan formats` lists"
        return ""

    def manifest(self, name: str, template: FleetTemplate) -> dict[str, tuple[int, str]]:
        """Return bytes and SHA-256 ("" where not stated) by name, as a folder's manifest lists them."""
        place = f"{self.root}/{name}/{template.manifest}"
        try:
            with self._answering():
                content = self.fs.cat_file(place)
            rows = csv.DictReader(io.StringIO(content.decode("utf-8-sig")))
            listed = {row["name"]: (int(row["bytes"]), (row.get("sha256") or "").lower()) for row in rows}
        except (ValueError, KeyError, TypeError, csv.Error) as error:
            raise ConfigError(
                f"not a list of files: {error!r}", expected="CSV with columns name, bytes, sha256", file=place
            ) from error
        if not listed:
            raise ConfigError("the manifest lists no file", expected="each raw log", file=place)
        return listed

    def fetch(self, name: str, template: FleetTemplate, home: Path) -> Path:
        """Return the folder of raw logs on this machine, checked against its manifest; a bucket's are copied.

        Raises
        ------
        ChangingLogError
            where a file changes meanwhile.
        ConfigError
            where a file is not what the manifest says, or an object's name would lead elsewhere.
        """
        listing = self.listing(name)
        if reason := self._lacks(name, listing, template):  # the flow may be started by hand
            raise ConfigError(reason, change="upload what is missing", file=f"{self.root}/{name}")
        logs = Path(self.root) / name if self.is_local else home / f"raw-{listing.digest[:12]}"
        for file, (size, _) in {} if self.is_local else listing.files.items():
            if ".." in file.split("/"):
                raise ConfigError(f"an object is named {file!r}", expected="a name without ..", file=name)
            copy = logs / file
            if not copy.exists():
                copy.parent.mkdir(parents=True, exist_ok=True)
                part = copy.with_name(f".{copy.name}.part")
                with self._answering():
                    self.fs.get_file(f"{self.root}/{name}/{file}", str(part))
                part.replace(copy)
            if copy.stat().st_size != size:
                copy.unlink()
                raise ChangingLogError(
                    "the object changed while it was copied", change="wait for its upload", file=copy
                )
        wanted = self.manifest(name, template) if template.manifest in listing.files else {}
        for file, (_, digest) in wanted.items():
            with (logs / file).open("rb") as stream:
                if digest and hashlib.file_digest(stream, "sha256").hexdigest() != digest:
                    raise ConfigError(f"not the content of {template.manifest}", change="upload it again", file=file)
        if self.listing(name).digest != listing.digest:
            raise ChangingLogError("files changed while they were checked", change="wait for the upload", file=logs)
        return logs

    def record(self, name: str) -> Record | None:
        """Return what is remembered of a folder; StoreError where its record is damaged."""
        file = self._file(name)
        try:
            values: Any = parse_checked(file.read_bytes())
            return Record(**{key: value for key, value in values.items() if key != "checksum"})
        except FileNotFoundError:
            return None
        except (ValueError, TypeError) as error:
            raise StoreError(
                f"the record of an arrival is damaged: {error}", file=file,
                change="remove it to have the folder looked at anew",
            ) from error  # fmt: skip

    def keep(self, name: str, record: Record) -> None:
        """Remember what is known of a folder."""
        file = self._file(name)
        file.parent.mkdir(parents=True, exist_ok=True)
        draft = file.with_name(f".{uuid.uuid4().hex}")
        draft.write_bytes(checked_json(asdict(record)))
        draft.replace(file)

    @contextlib.contextmanager
    def _answering(self) -> Iterator[None]:
        """Raise StoreError where the watched place does not answer."""
        try:
            yield
        except Exception as error:  # each library of an object store has different ones
            raise StoreError(
                f"the watched folder {self.root} cannot be read: {error}",
                change="see to its address, the network and your keys",
            ) from error

    def _file(self, name: str) -> Path:
        return self.surveys / RECORDS / f"{name}.json"


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
