"""What a store holds that nothing needs any more, and its removal. Raw logs and what people changed are never touched.

Each file of a store is one of: needed (a record names it, or it is a record); or of one of the kinds below; or it lies
where roadscan writes nothing, and is nobody's business here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Final

from roadscan.core.counted import counted
from roadscan.core.errors import ConfigError, RunError
from roadscan.ingest.planned_logs import logs_of
from roadscan.navigation.tasks.navigate import known_keys
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.logs import NAVIGATION, LogRecord, copies_alone, copy_path, log_of, read_log_records, record_path
from roadscan.store.store import Store
from roadscan.tiles.product import products as known_products

SUPERSEDED: Final = "superseded"
"""Rows of logs that were read again with other settings."""
DAMAGED: Final = "damaged"
"""Files that were damaged, and that others replaced."""
UNUSED: Final = "unused"
"""Rows of logs that the survey file does not name any more."""
UNRECORDED: Final = "unrecorded"
"""Files in folders of tables and products that no record names: a run that was stopped left them."""

KINDS: Final = {
    SUPERSEDED: "rows of logs that were read again with other settings",
    DAMAGED: "damaged files that others replaced",
    UNUSED: "rows of logs that the survey file names no more",
    UNRECORDED: "files that no record names",
}
"""What can be removed, in words."""


@dataclass(frozen=True)
class Waste:
    """A file that nothing needs."""

    kind: str
    """One of `KINDS`, or a product whose files shall go."""
    path: str
    """Relative to the survey's root."""
    bytes: int
    changed_s: float
    """When it was written (Unix s), by the store's clock."""


def waste_of(
    session: Session, kinds: Collection[str] = tuple(KINDS), products: Collection[str] = (), older_s: float = 0.0
) -> list[Waste]:
    """Return what can be removed from a survey's store, by kind and path.

    Parameters
    ----------
    kinds : of `KINDS`.
    products : names of products whose files are listed too: a run that is asked for them makes them again.
    older_s : files that were written after this (seconds before now, by the store's clock) are left out.

    Raises
    ------
    ConfigError
        for a kind that there is not, and a product that there is not.
    RunError
        where a log of the survey file cannot be read, so that nobody knows which logs are unused.
    """
    store = session.store
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise ConfigError(f"nothing is called '{unknown[0]}'", expected=", ".join(KINDS), change="name one of these")
    made = session.manifest.files()
    if missing := [product for product in products if product not in made and product not in known_products()]:
        raise ConfigError(f"the store has no file of '{missing[0]}'", expected=f"one of {', '.join(sorted(made))}")
    records = read_log_records(store)
    unused = _unused(session, records) if UNUSED in kinds else set()
    chosen = {path: kind for kind, path in _found(session, records, unused) if kind in kinds}
    chosen |= {r.path: r.product for product in products for r in session.manifest.of(product).values() if r.path}
    return sorted(_sized(store, chosen, older_s), key=lambda one: (one.kind, one.path))


def remove_waste(session: Session, waste: Collection[Waste]) -> None:
    """Remove these files from the store (requires its lock), with the records of products and logs among them."""
    store = session.store
    gone = {one.path for one in waste}
    for record in read_log_records(store):
        if record_path(record.key) in gone:
            for path in (
                copy_path(record.key),
                record_path(record.key),
            ):  # before its rows; a copy is found by its record
                store.remove(path)
    kinds = {one.kind for one in waste} - KINDS.keys()
    session.manifest.remove([r for kind in kinds for r in session.manifest.of(kind).values() if r.path in gone])
    for one in waste:
        store.remove(one.path)


def _found(session: Session, records: Collection[LogRecord], unused: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield kind and path of all files that nothing needs."""
    store = session.store
    needed = {r.path for r in session.manifest.all()}
    keys = {record.key for record in records}
    for folder in (SUPERSEDED, DAMAGED):
        yield from ((folder, path) for path in store.files(folder))
    for record in records:
        if record.key in unused:
            yield from ((UNUSED, path) for path in (record_path(record.key), copy_path(record.key)))
            yield from ((UNUSED, one.path) for files in record.tables.values() for one in files)
    needed |= {one.path for record in records for files in record.tables.values() for one in files}
    for path in store.files("tables"):
        if (key := log_of(path)) and path not in needed and key not in keys and not path.startswith(_FOOTPRINTS):
            yield UNRECORDED, path
    yield from ((UNRECORDED, path) for path in copies_alone(store))
    for folder in {folder for stage in stages() for folder in stage.folders()}:
        yield from ((UNRECORDED, path) for path in store.files(folder) if path not in needed)


_FOOTPRINTS: Final = "tables/footprints/"
"""Folder of footprints, which lie below the names of their logs and are outputs with records of their own."""


def _unused(session: Session, records: Collection[LogRecord]) -> set[str]:
    """Return the keys of logs that the survey file does not name."""
    _, unplanned = logs_of(session)
    if unplanned:
        raise RunError(
            f"{counted(len(unplanned), 'log')} of the survey file cannot be read: {unplanned[0].error}",
            expected="logs that can be read: else theirs would count as unused",
            change="put them right, or leave out 'unused'",
        )
    used = {*known_keys(session.survey, session.store, logs_of(session))}
    runs = {run.id for run in session.survey.config.runs}
    # A trajectory of a run that is there is the run's to replace: where it cannot be planned now, its key is not known.
    return {r.key for r in records if r.key not in used and not (r.sensor == NAVIGATION and r.run in runs)}


def _sized(store: Store, chosen: dict[str, str], older_s: float) -> Iterator[Waste]:
    now_s = store.now_s() if older_s else 0.0
    for path, kind in chosen.items():
        size = store.size(path)
        if size is None:
            continue
        one = Waste(kind, path, size, store.changed_s(path) if older_s else 0.0)
        if not older_s or now_s - one.changed_s >= older_s:
            yield one


def summed(waste: Collection[Waste]) -> list[tuple[str, int, int]]:
    """Return kind, number of files and bytes."""
    kinds = dict.fromkeys(one.kind for one in waste)
    return [
        (kind, sum(one.kind == kind for one in waste), sum(one.bytes for one in waste if one.kind == kind))
        for kind in kinds
    ]
