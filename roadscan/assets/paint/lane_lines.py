"""Lane lines: pieces of all tiles, joined along each line, with their pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetObject
from roadscan.assets.paint.chains import Bands, Run, joined
from roadscan.assets.paint.double_lines import paired
from roadscan.assets.paint.patterns import Stretch, patterned
from roadscan.compute.array_types import Float64

_SHORTEST_M: Final = 1.0
"""Isolated paint shorter than this (m) is no line."""


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Pieces (n,) of all tiles, in canonical order."""

    ends: Float64
    """(n, 2, 3) start and end: easting, northing, height."""
    seen: npt.NDArray[np.bool_]
    """(n, 2) mask of ends with bare ground beyond."""
    table: pa.Table

    @property
    def length_m(self) -> Float64:
        """Returns the lengths (n,) of the pieces."""
        return np.asarray(np.hypot(*(self.ends[:, 1, :2] - self.ends[:, 0, :2]).T))

    def numbers(self, name: str) -> Float64:
        """Returns a column of the table (n,)."""
        return np.asarray(self.table[name].to_numpy(), np.float64)


def lane_lines(table: pa.Table, longest_gap_m: float) -> list[AssetObject]:
    """Lane lines of the pieces (:data:`~roadscan.assets.paint.line_pieces.LINE_PIECES`), by easting and northing."""
    pieces = _sorted(table)
    if not pieces.table.num_rows:
        return []
    direction = (pieces.ends[:, 1, :2] - pieces.ends[:, 0, :2]) / np.maximum(pieces.length_m, 1e-9)[:, None]
    outward = np.stack([-direction, direction], axis=1)
    width = pieces.numbers("width_m")
    runs = joined(Bands(pieces.ends[:, :, :2], outward, pieces.length_m, width), 0.0)
    stretches = [_stretch(pieces, run) for run in runs]
    ends = np.array([[s.line[0, :2], s.line[-1, :2]] for s in stretches])
    turns = np.array(
        [[outward[r.pieces[0], int(r.turned[0])], outward[r.pieces[-1], int(not r.turned[-1])]] for r in runs]
    )
    bands = Bands(ends, turns, np.array([s.length_m for s in stretches]), np.array([s.width_m for s in stretches]))
    chains = joined(bands, longest_gap_m)
    lines = [_object(pieces, group) for chain in chains for group in patterned(_in_order(stretches, chain))]
    long = [line for line in lines if line.attributes["length_m"] >= _SHORTEST_M]
    return sorted(paired(long), key=lambda line: (line.geometry.coords[0], line.geometry.coords[-1]))


def _sorted(table: pa.Table) -> _Pieces:
    """Returns the pieces, sorted by their ends."""
    names = [f"{end}_{axis}_m" for end in ("begin", "end") for axis in ("x", "y", "height")]
    ends = np.stack([np.asarray(table[name].to_numpy(), np.float64) for name in names], axis=1).reshape(-1, 2, 3)
    seen = np.stack(
        [np.asarray(table[n].to_numpy(zero_copy_only=False), np.bool_) for n in ("begin_seen", "end_seen")], 1
    )
    order = np.lexsort(ends.reshape(-1, 6).T[::-1])
    return _Pieces(ends[order], seen[order], table.take(pa.array(order)))


def _stretch(pieces: _Pieces, run: Run) -> Stretch:
    """Returns paint without a gap: its centre line, midway between pieces that meet."""
    nodes = np.concatenate([pieces.ends[p][:: -1 if t else 1] for p, t in zip(run.pieces, run.turned, strict=True)])
    if len(run.pieces) > 1:
        inner = (nodes[1:-1:2] + nodes[2:-1:2]) / 2
        nodes = np.concatenate([nodes[:1], inner, nodes[-1:]])
    first, last = run.pieces[0], run.pieces[-1]
    seen = bool(pieces.seen[first, int(run.turned[0])]), bool(pieces.seen[last, int(not run.turned[-1])])
    numbers = list(run.pieces)
    weight = np.maximum(pieces.length_m[numbers], 1e-3)
    width = _middle(pieces.numbers("width_m")[numbers], weight)
    return Stretch(nodes, tuple(run.pieces), seen, float(np.hypot(*np.diff(nodes[:, :2], axis=0).T).sum()), width)


def _in_order(stretches: list[Stretch], chain: Run) -> list[Stretch]:
    return [
        stretches[k].turned() if turned else stretches[k] for k, turned in zip(chain.pieces, chain.turned, strict=True)
    ]


def _object(pieces: _Pieces, group: tuple[str | None, list[Stretch]]) -> AssetObject:
    """Returns a line of stretches of one pattern."""
    kind, stretches = group
    numbers = [p for s in stretches for p in s.pieces]
    weight = np.maximum(pieces.length_m[numbers], 1e-3)
    line = shapely.LineString(np.concatenate([s.line for s in stretches]))
    dashes = np.array([s.length_m for s in stretches])
    gaps = [float(np.hypot(*(b.line[0, :2] - a.line[-1, :2]))) for a, b in pairwise(stretches)]
    dashed = kind == "dashed"
    whole = dashes[[s.seen == (True, True) for s in stretches]]
    attributes = {
        "type": kind,
        "width_m": _middle(pieces.numbers("width_m")[numbers], weight),
        "dash_m": float(np.median(whole)) if dashed and whole.size else None,
        "gap_m": float(np.median(gaps)) if dashed and gaps else None,
        "colour": None,
        "contrast": 1.0 + _middle(pieces.numbers("contrast")[numbers], weight),
        "length_m": float(line.length),
    }
    return AssetObject(
        geometry=line,
        sigma_horizontal_m=_middle(pieces.numbers("sigma_across_m")[numbers], weight),
        sigma_height_m=_middle(pieces.numbers("sigma_height_m")[numbers], weight),
        probability=float(np.average(pieces.numbers("probability")[numbers], weights=weight)),
        returns=int(pieces.numbers("returns")[numbers].sum()),
        passes=len({p for k in numbers for p in pieces.table["passes"][k].as_py()}),
        first_epoch_gps_ns=min(pieces.table["first_epoch_gps_ns"][k].as_py() for k in numbers),
        last_epoch_gps_ns=max(pieces.table["last_epoch_gps_ns"][k].as_py() for k in numbers),
        attributes=attributes,
        sigma_size_m=math.sqrt(2.0) * _middle(pieces.numbers("sigma_across_m")[numbers], weight),
    )


def _middle(values: Float64, weight: Float64) -> float:
    """Returns the weighted median."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order][int(np.searchsorted(total, total[-1] / 2))])
