"""Queries a survey's tables; for a missing table, the error says what makes it."""

from __future__ import annotations

from typing import Final

import pyarrow as pa

from roadscan.core.errors import RoadscanError, StoreError
from roadscan.core.survey import Survey
from roadscan.ingest.reading.format import log_formats
from roadscan.navigation.tasks.navigate import known_keys
from roadscan.store.asset_schema import asset_tables
from roadscan.store.schema import schema_names
from roadscan.store.sql import missing_table, query
from roadscan.store.store import Store
from roadscan.tiles.product import SurveyProduct, products
from roadscan.tiles.tasks.wanted_products import wanted_products

_MADE_BY: Final = {
    "cells": "`roadscan run` makes it",
    "overviews": "`roadscan run` makes it",
    "footprints": "`roadscan run` makes it",
    "outputs": "`roadscan run` makes it",
    "clocks": "`roadscan clocks` makes it, where the survey file says what a clock is found from",
    "clock_residuals": "`roadscan clocks` makes it, where the survey file says what a clock is found from",
    **dict.fromkeys(
        (
            "corrections",
            "mounting_corrections",
            "ties",
            "tie_residuals",
            "control_sightings",
            "control_residuals",
            "relative_accuracy",
            "absolute_accuracy",
            "accuracy_by_distance",
        ),
        "`roadscan adjust` makes it, where passes overlap or come by ground control",
    ),
    "mountings": "`roadscan calibrate` makes it, from the [[calibration]] of the survey file",
    "intensity_gains": "`roadscan assets` makes it, where the survey file has a section [assets]",
    "asset_visibility": "`roadscan assets` makes it, where the survey file has a section [assets]",
    "innovations": "`roadscan navigate` makes it, for runs with GNSS and IMU",
    "navigation_states": "`roadscan navigate` makes it, for runs with GNSS and IMU",
    "regions": 'a run makes it with regions = "found" in [surface]',
    "reading_classes": "`roadscan classes` writes it as a file of its own; read that with read_parquet",
}
"""What makes the tables that are neither ingested nor a product."""


def ask(
    survey: Survey,
    store: Store,
    statement: str,
    damaged: list[StoreError] | None = None,
    *,
    unconfined: bool = False,
) -> pa.Table:
    """Return the result of a DuckDB statement over a survey's tables (:func:`roadscan.store.sql.query`).

    Raises
    ------
    RoadscanError
        The statement fails; of a table that is not there yet it says what makes it.
    """
    try:
        return query(store, statement, known_keys(survey, store), damaged, unconfined=unconfined)
    except RoadscanError as error:
        name = missing_table(error.__cause__)
        told = None if name is None else not_made(name, survey)
        if told is None:
            raise
        raise told from error


def not_made(name: str, survey: Survey) -> RoadscanError | None:
    """Return the error that says what makes a missing table; None where no such table is known."""
    way = _way_to(name.removesuffix("_between"), survey)
    return None if way is None else RoadscanError(f"the table '{name}' is not made yet", change=way)


def _way_to(table: str, survey: Survey) -> str | None:
    """Return what makes a table; None where no such table is known."""
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
    return "no log of the survey that is in the store yields it" + (
        f"; these do: {', '.join(formats)}" if formats else ""
    )
