"""Queries a survey's tables; for a missing table, the error says what makes it."""

from __future__ import annotations

from typing import Final

import pyarrow as pa

from roadscan.core.errors import RoadscanError, StoreError
from roadscan.core.survey import Survey
from roadscan.store.asset_schema import asset_tables
from roadscan.store.query.sql import Limits, missing_table, query
from roadscan.store.schema import schema_names
from roadscan.store.store import Store

_MADE_BY: Final = {
    "mountings": "`roadscan calibrate` makes it, from the [[calibration]] of the survey file",
    "outputs": "`roadscan run` makes it",
    "reading_classes": "`roadscan classes` writes it as a file of its own; read that with read_parquet",
    "run_history": "`roadscan run` writes it when it ends",
    "regions": 'a run makes it with regions = "found" in [surface]',
}
"""What makes tables that no stage writes, or not always."""


def ask(
    survey: Survey,
    store: Store,
    statement: str,
    damaged: list[StoreError] | None = None,
    *,
    unconfined: bool = False,
    limits: Limits | None = None,
) -> pa.Table:
    """Return the result of a DuckDB statement over a survey's tables (:func:`roadscan.store.query.sql.query`).

    Raises
    ------
    RoadscanError
        The statement fails; of a table that is not there yet it says what makes it.
    """
    try:
        return query(
            store,
            statement,
            lambda: _known_keys(survey, store),
            damaged,
            unconfined=unconfined,
            limits=limits or Limits(),
        )
    except RoadscanError as error:
        name = missing_table(error.__cause__)
        told = None if name is None else not_made(name, survey)
        if told is None:
            raise
        raise told from error


def _known_keys(survey: Survey, store: Store) -> list[str]:
    from roadscan.navigation.tasks.navigate import known_keys

    return known_keys(survey, store)


def not_made(name: str, survey: Survey) -> RoadscanError | None:
    """Return the error that says what makes a missing table; None where no such table is known."""
    way = _way_to(name.removesuffix("_between"), survey)
    return None if way is None else RoadscanError(f"the table '{name}' is not made yet", change=way)


def _way_to(table: str, survey: Survey) -> str | None:
    """Return what makes a table; None where no such table is known."""
    from roadscan.ingest.reading.format import log_formats
    from roadscan.run.stage import stages
    from roadscan.tiles.product import SurveyProduct, products
    from roadscan.tiles.tasks.wanted_products import wanted_products

    if table in asset_tables():
        return (
            f"`roadscan assets` makes it, where the survey file's [assets] asks for the kind '{asset_tables()[table]}'"
        )
    if table not in schema_names() and table not in _MADE_BY:
        return None
    made = next((p for p in products().values() if isinstance(p, SurveyProduct) and p.table == table), None)
    if made is not None:
        if any(product is made for product, _ in wanted_products(survey)):
            return "`roadscan run` makes it"
        return f'add "{made.name}" to [products] make, and run again'
    if table in _MADE_BY:
        return _MADE_BY[table]
    formats = [name for name, one in log_formats().items() if table in one.yields]
    if formats:
        return f"no log of the survey that is in the store yields it; these do: {', '.join(formats)}"
    stage = next((one for one in stages() if table in one.writes), None)
    if stage is None:
        return None
    asked = "" if stage.is_asked(survey) else f", where [{stage.section}] of the survey file asks for it"
    return f"`roadscan {stage.word}` makes it ({stage.title}){asked}"
