"""Overhead wires, from support to support, with their sag and the least height above what lies below."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets import classes
from roadscan.assets.judgement.judge import Judge
from roadscan.assets.kind import AssetKind, AssetObject, Evidence, Marked
from roadscan.assets.memory import once_a_scene
from roadscan.assets.scene import Scene
from roadscan.assets.wires.spans import Span, features_of, spans_of
from roadscan.assets.wires.thin import PIECE_SCHEMA, thin_cubes
from roadscan.compute.array_types import Int64

JUDGE: Final = Judge("wire", "58f4c2a3f7c55a32")
"""Who is asked whether a span is a wire."""
_LEAST: Final = 0.5
"""Less probable spans are left out."""
_VERTEX_M: Final = 1.0
"""Distance of the vertices of a line (m): with a sag of 0.5 m over 25 m, the curve leaves its chords by 1 mm."""
_INDEPENDENT_M: Final = 1.0
"""Cubes closer along a span than this (m) share the errors of one turn of the scanner."""


class Wire(AssetKind):
    """Overhead wires: spans of cubes in the air (:mod:`roadscan.assets.wires`)."""

    name = "wire"
    title = "Overhead wires"
    piece_schema = PIECE_SCHEMA

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        """Returns cubes of the tile that lie on a straight level line in the air."""
        pieces, rows = _cubes_of(scene)
        east, north = scene.returns.corner_m
        own = scene.tile.holds(np.asarray(pieces["easting_m"]) - east, np.asarray(pieces["northing_m"]) - north)
        return Evidence(pieces.filter(pa.array(own)), (Marked(rows, classes.WIRE),))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        """Yields a line for each span, by its first place."""
        found = [_object(pieces, *one) for one in judged(pieces)]
        yield from sorted(found, key=lambda one: one.geometry.coords[0])


@once_a_scene
def _cubes_of(scene: Scene) -> tuple[pa.Table, Int64]:
    """Returns the cubes of a scene that lie on a line, and the returns of wires."""
    pieces, held = thin_cubes(scene)
    marked = [held[k] for span, _ in judged(pieces) for k in span.rows.tolist()]
    return pieces, np.concatenate(marked) if marked else np.empty(0, np.int64)


def judged(pieces: pa.Table) -> list[tuple[Span, float]]:
    """Returns the spans that are probably wires, each with its probability."""
    spans = list(spans_of(pieces))
    stated = JUDGE.of_each([features_of(one, pieces) for one in spans]).tolist()
    return [(span, p) for span, p in zip(spans, stated, strict=True) if p >= _LEAST]


def _object(pieces: pa.Table, span: Span, probability: float) -> AssetObject:
    own = pieces.take(pa.array(span.rows))
    ground = np.asarray(own["height_m"]) - np.asarray(own["clearance_m"])
    clearance = float(np.min(np.polyval(span.heights, span.along_m) - ground))
    along = np.linspace(span.along_m[0], span.along_m[-1], 2 + int(span.length_m / _VERTEX_M))
    line = span.places_m(along)
    if tuple(line[-1]) < tuple(line[0]):
        line = line[::-1]
    sigma = np.sqrt(np.mean(span.off_m**2, axis=0) / max(span.length_m / _INDEPENDENT_M, 1.0))
    passes = {one for row in own["passes"].to_pylist() for one in row}
    return AssetObject(
        shapely.LineString(line), float(sigma[0]), float(sigma[1]), probability,
        int(np.sum(np.asarray(own["returns"]))), len(passes), int(np.min(np.asarray(own["first_epoch_gps_ns"]))),
        int(np.max(np.asarray(own["last_epoch_gps_ns"]))),
        {"length_m": span.length_m, "sag_m": span.sag_m, "clearance_m": clearance}, math.sqrt(2.0) * float(sigma[1]),
    )  # fmt: skip
