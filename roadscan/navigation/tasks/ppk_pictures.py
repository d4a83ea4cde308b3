"""Draws pictures of post-processed GNSS positions from the store."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa

from roadscan.core.extras import can_draw
from roadscan.core.survey import Survey
from roadscan.navigation.ppk_picture import COLUMNS, PpkPicture, draw_ppk
from roadscan.navigation.tasks.recorded_pictures import keep_file, remove_others
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.logs import LogRecord
from roadscan.store.manifest import Manifest
from roadscan.store.readings.row_groups import read_groups
from roadscan.store.store import Store

PPK_PICTURE: Final = "ppk_picture"
"""Product of the records."""
_FOLDER: Final = "products/navigation"
PPK: Final = "ppk"
"""Format of the logs, and entry of their records with the figures."""


def ppk_picture_path(record: LogRecord) -> str:
    """Return the path of the picture of a log, relative to the survey's root."""
    return f"{_FOLDER}/{_unit(record)}.png"


def _unit(record: LogRecord) -> str:
    return f"{record.run}-{record.sensor}-{PPK}-{record.key[:8]}"


def draw_post_processed(
    survey: Survey, store: Store, records: Sequence[LogRecord], report: Callable[[str], None]
) -> None:
    """Draw the pictures of logs that were post-processed which are missing, damaged or stale; remove others.

    Without Matplotlib there are none.

    Parameters
    ----------
    records : of the survey's logs.
    """
    own = {_unit(one): one for one in records if one.format == PPK and PPK in one.attributes} if can_draw() else {}
    if not own and not store.files(_FOLDER):
        return
    manifest = Manifest(store)
    remove_others(manifest, PPK_PICTURE, own)
    for unit, record in own.items():
        title = f"{survey.config.id}, run {record.run}, {record.path}"
        key = key_of(code_digest("roadscan.navigation.ppk_picture"), title, record.key)
        files = record.tables.get("gnss", ())
        if manifest.is_current(PPK_PICTURE, unit, key) or not files:
            continue
        rows = pa.concat_tables(
            [read_groups(store, one.path, range(len(one.group_rows)), list(COLUMNS)) for one in files]
        )
        picture, target = PpkPicture.of(title, rows, record.attributes[PPK]), ppk_picture_path(record)

        def write(path: Path, picture: PpkPicture = picture) -> None:
            draw_ppk(path, picture)

        keep_file(store, manifest, (PPK_PICTURE, unit), key, target, write)
        report(f"drawn: {target}")
