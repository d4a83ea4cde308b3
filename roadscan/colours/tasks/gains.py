"""Gains of the pictures of a run: a table of how each is made as bright as the others, and how sharp it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from roadscan.colours.gains import gains_of
from roadscan.colours.tasks.depths import read_samples
from roadscan.colours.tasks.plan import DEPTHS, ColourPlan
from roadscan.compute.array_types import Float64
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import Manifest, OutputRecord, recorded_table
from roadscan.store.schema import table_schema
from roadscan.store.store import Store
from roadscan.store.writer import parquet_bytes

GAINS: Final = "picture_gains"
_DIGITS: Final = 3
"""Decimals of gains: a picture more changes those of far ones by less, so their tiles stay as they are."""
_LEAST_WEIGHT: Final = 0.05  # Least weight of a blurred picture.
_SHARP: Final = 2.0  # Power of the relative sharpness that is the weight.


@dataclass(frozen=True)
class GainsTable:
    """The gains of the pictures of a run."""

    run: str
    key: str
    depths: tuple[OutputRecord, ...]
    """Batches of the run, in the order of time."""
    balance: bool


def plan_gains(plan: ColourPlan, manifest: Manifest) -> list[GainsTable]:
    """Returns the tables of all runs; their keys are those of the batches as they stand in the manifest."""
    code = code_digest("roadscan.colours.tasks.gains:write_gains")
    found = []
    for run in sorted({one.run for one in plan.batches}):
        held = [manifest.get(DEPTHS, one.unit) for one in plan.batches if one.run == run]
        records = tuple(one for one in held if one is not None)
        key = key_of(code, plan.config.balance, [one.digest for one in records])
        found.append(GainsTable(run, key, records, plan.config.balance))
    return found


def write_gains(store: Store, table: GainsTable) -> OutputRecord:
    """Compute the gains of a run from the samples of its pictures, and write them."""
    held = [read_samples(store, record) for record in table.depths]
    samples = [one for batch in held for one in batch.samples]
    gains, compared = gains_of(samples) if table.balance else (np.ones((len(samples), 3)), np.zeros(len(samples), int))
    sharpness = np.array([value for batch in held for value in batch.sharpness])
    reasons = [value for batch in held for value in batch.reasons]
    schema = table_schema(GAINS)
    rows = pa.table(
        {
            "run": [table.run] * len(samples), "camera": [v for b in held for v in b.cameras],
            "file": [v for b in held for v in b.files], "epoch_gps_ns": [v for b in held for v in b.epochs_gps_ns],
            **{f"gain_{name}": np.round(gains[:, k], _DIGITS) for k, name in enumerate(("red", "green", "blue"))},
            "compared": compared, "sharpness": sharpness,
            "weight": np.where([bool(v) for v in reasons], 0.0, np.round(weights_of(sharpness), _DIGITS)),
            "reason": [v or None for v in reasons],
        },
        schema=schema.arrow(),
    )  # fmt: skip
    content, target = parquet_bytes(rows, schema), f"{schema.location}/{table.run}.parquet"
    store.write_bytes(target, content, lasting=False)
    return OutputRecord(GAINS, table.run, table.key, target, len(content), bytes_digest(content))


def weights_of(sharpness: Float64) -> Float64:
    """Returns the weights (n,) of pictures by their sharpness (n,): 1 from the median of the run on."""
    known = sharpness[sharpness > 0.0]
    if not known.size:
        return np.ones(sharpness.size)
    return np.clip((sharpness / np.median(known)) ** _SHARP, _LEAST_WEIGHT, 1.0)


@dataclass(frozen=True, eq=False)
class PictureGains:
    """Gains and weights of the pictures of a survey, by their numbers."""

    gain: Float64
    """(n, 3) factors of red, green and blue."""
    weight: Float64
    """(n,) of sharpness."""
    reason: tuple[str, ...]
    """(n,) why a picture gives no colour; empty where it does."""


def read_gains(plan: ColourPlan, manifest: Manifest, tables: Sequence[GainsTable]) -> PictureGains:
    """Returns the gains of all pictures of the survey."""
    count = len(plan.pictures)
    gain, weight, reason = np.ones((count, 3)), np.ones(count), [""] * count
    pictures = plan.pictures
    named = zip(pictures.log.tolist(), pictures.files, pictures.epochs_gps_ns.tolist(), strict=True)
    rows: Mapping[tuple[str, str, str, int], int] = {  # two logs may have files of one name
        (pictures.logs[log].run, pictures.logs[log].sensor, file, epoch): number
        for number, (log, file, epoch) in enumerate(named)
    }
    for table in tables:
        record = manifest.get(GAINS, table.run)
        if record is None:
            continue
        held = recorded_table(plan.survey.store, record)
        for row in held.to_pylist():
            number = rows.get((row["run"], row["camera"], row["file"], row["epoch_gps_ns"]), -1)
            if number < 0:
                continue  # a table of other pictures: it is due
            gain[number] = row["gain_red"], row["gain_green"], row["gain_blue"]
            weight[number], reason[number] = row["weight"], row["reason"] or ""
    return PictureGains(gain, weight, tuple(reason))
