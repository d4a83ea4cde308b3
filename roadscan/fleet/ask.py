"""Asks the tables of all surveys of a fleet at once."""

from __future__ import annotations

import pyarrow as pa

from roadscan.core.errors import RoadscanError, StoreError
from roadscan.fleet.catalogue import TABLE, doubled, read_catalogue
from roadscan.fleet.members import surveys_in
from roadscan.store.query.sql import Limits, missing_table, query
from roadscan.store.query.sql_fleet import FleetStores


def ask_fleet(
    place: str,
    statement: str,
    damaged: list[StoreError] | None = None,
    *,
    unconfined: bool = False,
    limits: Limits | None = None,
) -> pa.Table:
    """Return the result of a DuckDB statement over the tables of all surveys of a folder or bucket.

    Each table has the rows of all surveys with their id as the first column, `survey`; the table `fleet` is the
    catalogue. A survey that cannot be shown is an error, or joins `damaged`: its survey file cannot be read, or its id
    is that of another one too.

    Raises
    ------
    RoadscanError
        The statement fails; of a table that no survey has it says so.
    """
    found = surveys_in(place)
    shown = []
    for one in found:
        notes = [one.fault] if one.store is None else doubled(found, one)
        if notes:
            fault = StoreError(f"the survey {one.file or one.id} is not shown: {notes[0]}")
            if damaged is None:
                raise fault
            damaged.append(fault)
        else:
            shown.append(one.member())
    catalogue = read_catalogue(place)
    beside = {} if catalogue is None else {TABLE: catalogue}
    try:
        return query(
            FleetStores(shown, beside), statement, None, damaged, unconfined=unconfined, limits=limits or Limits()
        )
    except RoadscanError as error:
        name = missing_table(error.__cause__)
        if name is None:
            raise
        change = (
            f"`roadscan fleet {place}` makes it"
            if name == TABLE
            else f"`roadscan sql --fleet {place} 'SHOW TABLES'` lists all"
        )
        raise RoadscanError(f"no survey of {len(shown)} has the table '{name}'", change=change) from error
