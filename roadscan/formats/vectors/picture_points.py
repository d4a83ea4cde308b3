"""Converts points measured in pictures to rows of the table `picture_points`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa

from roadscan.compute.array_types import Float64, Int64
from roadscan.ingest.reading.format import Item, Rows
from roadscan.ingest.reading.records import Sieve

TABLE: Final = "picture_points"
BY_HAND, FOUND = "by hand", "found"
"""Sources of measurements."""
_FARTHEST_PX: Final = 200_000.0  # places farther from a picture's corner count as damage (pixels)
_LARGEST_SIGMA_PX: Final = 1_000.0  # larger σ count as damage (pixels)
_NO_TEXT: Final = "\ufffd"  # replaces bytes that could not be decoded


@dataclass(frozen=True)
class RawPoints:
    """n measurements as a file has them."""

    records: Int64
    offsets: Int64
    """−1 where there is none."""
    runs: Sequence[str | None]
    sensors: Sequence[str | None]
    pictures: Sequence[str]
    points: Sequence[str]
    uv_px: Float64
    """(2, n) from the centre of the upper left pixel."""
    sigma_px: Float64
    """(n,) NaN: not stated."""
    sources: Sequence[str]


def point_items(raw: RawPoints) -> Iterator[Item]:
    """Yield rows of the sound measurements, and rejects of the others."""
    sieve = Sieve(raw.records.size)
    names = list(zip(raw.pictures, raw.points, strict=True))
    sieve.drop(np.array([not picture for picture, _ in names], bool), "the picture has no name")
    sieve.drop(np.array([not point for _, point in names], bool), "the point has no name")
    texts = zip(raw.runs, raw.sensors, names, strict=True)
    sieve.drop(np.array([_NO_TEXT in f"{run}{sensor}{name}" for run, sensor, name in texts], bool), "a name is no text")
    sieve.require("u_px", raw.uv_px[0], -_FARTHEST_PX, _FARTHEST_PX, "px")
    sieve.require("v_px", raw.uv_px[1], -_FARTHEST_PX, _FARTHEST_PX, "px")
    stated = ~np.isnan(raw.sigma_px)
    outside = stated & ~((raw.sigma_px > 0.0) & (raw.sigma_px <= _LARGEST_SIGMA_PX))
    sieve.drop(outside, f"sigma_px is not above 0 and at most {_LARGEST_SIGMA_PX:g} px")
    sieve.drop(np.array([one not in (BY_HAND, FOUND) for one in raw.sources], bool), "source is neither of its words")
    yield from sieve.rejects(raw.records, raw.offsets)
    rows = np.flatnonzero(sieve.good)
    if not rows.size:
        return

    def chosen(values: Sequence[Any]) -> list[Any]:
        return [values[i] for i in rows.tolist()]

    columns = {
        "run": pa.array(chosen(raw.runs), pa.string()),
        "sensor": pa.array(chosen(raw.sensors), pa.string()),
        "picture": pa.array(chosen(raw.pictures), pa.string()),
        "point": pa.array(chosen(raw.points), pa.string()),
        "u_px": pa.array(raw.uv_px[0, rows]),
        "v_px": pa.array(raw.uv_px[1, rows]),
        "sigma_px": pa.array(raw.sigma_px[rows], mask=~stated[rows]),
        "source": pa.array(chosen(raw.sources), pa.string()),
    }
    yield Rows(TABLE, pa.RecordBatch.from_pydict(columns), records=raw.records[rows])
