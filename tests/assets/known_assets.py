"""Kinds of assets for tests of pictures: signs and lane lines that stand where the simulator put them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import shapely

from roadscan.assets.kind import AssetKind, AssetObject, Evidence
from roadscan.assets.scene import Scene
from roadscan.simulate import truth

_SHARES = {"triangle": np.sqrt(3.0) / 2.0, "round": 1.0, "octagon": 1.0, "diamond": 1.0}
_PLATE_BEFORE_POST_M = 0.04


def true_signs(folder: Any) -> list[tuple[shapely.Point, dict[str, Any]]]:
    """Middle and values of each sign of a simulated survey."""
    known = truth.load(folder)
    found = []
    for sign in known.scene.roadside.signs:
        e, n, heading = (np.ravel(v)[0] for v in known.surface.place(np.array([sign.station_m]), sign.offset_m))
        height = sign.width_m * _SHARES[sign.shape] if sign.shape in _SHARES else sign.height_m
        ground = float(np.ravel(known.height_m(e, n))[0])
        back = -_PLATE_BEFORE_POST_M if sign.faces == "backward" else _PLATE_BEFORE_POST_M
        place = e + back * np.sin(heading), n + back * np.cos(heading), ground + sign.clearance_m + height / 2
        facing = np.degrees(heading) + (180.0 if sign.faces == "backward" else 0.0)
        values = {"width_m": sign.width_m, "plate_height_m": float(height), "facing_deg": float(facing % 360.0),
                  "tilt_deg": 0.0, "shape": sign.shape}  # fmt: skip
        found.append((shapely.Point(place), values))
    return found


def true_lines(folder: Any) -> list[tuple[shapely.LineString, dict[str, Any]]]:
    """Each solid lane line of a simulated survey, from station 0 to its end."""
    known = truth.load(folder)
    found = []
    for marking in known.scene.road.markings:
        station = np.arange(0.0, known.scene.length_m, 1.0)
        e, n, _ = known.surface.place(station, np.full(station.size, marking.offset_m))
        line = shapely.LineString(np.column_stack([e, n, known.height_m(e, n)]))
        found.append((line, {"width_m": marking.width_m, "type": "solid", "length_m": line.length}))
    return found


class _Known(AssetKind):
    """Assets that are told beforehand."""

    assets: ClassVar[list[tuple[Any, dict[str, Any]]]] = []
    piece_schema = pa.schema([("number", pa.int64()), ("epoch_gps_ns", pa.int64())])

    def evidence(self, scene: Scene, options: Any) -> Evidence:
        r, (east, north) = scene.returns, scene.returns.corner_m
        places = [shape.centroid for shape, _ in self.assets]
        held = [n for n, p in enumerate(places) if scene.tile.holds(p.x - east, p.y - north)]
        rows = [{"number": n, "epoch_gps_ns": int(r.epoch_gps_ns.min())} for n in held]
        return Evidence(pa.Table.from_pylist(rows, schema=self.piece_schema))

    def objects(
        self, pieces: pa.Table, options: Any, others: Mapping[str, Sequence[AssetObject]]
    ) -> Iterable[AssetObject]:
        for one in pieces.to_pylist():
            shape, values = self.assets[one["number"]]
            epoch = one["epoch_gps_ns"]
            yield AssetObject(shape, 0.01, 0.01, 0.9, 100, 1, epoch, epoch, values)


class KnownSigns(_Known):
    name = "sign"
    title = "signs that are known"
    assets: ClassVar[list[tuple[Any, dict[str, Any]]]] = []


class KnownLines(_Known):
    name = "lane_line"
    title = "lines that are known"
    assets: ClassVar[list[tuple[Any, dict[str, Any]]]] = []
