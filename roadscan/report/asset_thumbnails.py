"""Draws thumbnails of a kind's assets for the report: cut-outs where there are any, else classified points."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.files.layers import Layer
from roadscan.assets.files.thumbnails import (
    drawn_from_above,
    drawn_from_side,
    fitted,
    read_classified,
    read_cut_out,
    sheet,
)
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.evidence import CLASSIFIED
from roadscan.assets.tasks.picture_work import CUT_OUTS
from roadscan.assets.tasks.plan import asset_grid
from roadscan.privacy.settings import publishes_as_they_are
from roadscan.run.session import Session
from roadscan.store.manifest import read_recorded

MOST: Final = 4
"""Thumbnails of a kind."""
_TRIED: Final = 12  # assets that are tried, the most probable first
_KEPT_SQUARES: Final = 4  # squares whose points stay in memory
_HEIGHT_M: Final = 3.0  # assumed height of an asset without one (m)
_ABOVE_PLATE_M: Final = 1.0  # height above a plate's place that is shown (m)


class Thumbnails:
    """Draws thumbnails of a survey's assets; points of a square are read once for neighbouring assets.

    A report is handed on: cut-outs of pictures stand in it only where `privacy.pictures` is off.
    """

    def __init__(self, session: Session) -> None:
        config = AssetsConfig.stated(session.survey)
        self._session = session
        self._grid = None if config is None else asset_grid(session.survey, config)
        shown = session.manifest.of(CUT_OUTS).values() if publishes_as_they_are(session.survey) else ()
        self._cut_outs = {r.path: r for r in shown}
        self._points = {unit: r for unit, r in session.manifest.of(CLASSIFIED).items() if r.path}
        self._read: OrderedDict[str, tuple[Any, Any, Any]] = OrderedDict()

    def of(self, layer: Layer) -> bytes | None:
        """Return a sheet of a kind's most probable assets, cut-outs before points; None where nothing shows them."""
        rows = layer.rows
        cut = [name is not None for name in rows["cut_out"].to_pylist()] if "cut_out" in rows.schema.names else []
        has_cut = np.array(cut or [False] * rows.num_rows)
        order = np.lexsort((rows["object"].to_numpy(), -rows["probability"].to_numpy(), ~has_cut))[:_TRIED]
        near = sorted(order.tolist(), key=lambda n: (not has_cut[n], self._square(rows, n), n))
        found: list[npt.NDArray[np.uint8]] = []
        for number in near:
            one = self._one(layer, number)
            if one is not None:
                found.append(one)
            if len(found) == MOST:
                break
        return sheet(found) if found else None

    def _one(self, layer: Layer, number: int) -> npt.NDArray[np.uint8] | None:
        """Return the cut-out of an asset, or its points."""
        row = {name: layer.rows[name][number].as_py() for name in layer.rows.schema.names}
        record = self._cut_outs.get(row.get("cut_out") or "")
        if record is not None:
            picture = read_cut_out(read_recorded(self._session.store, record))
            if picture is not None:
                return fitted(picture)
        points = self._points_of(self._square(layer.rows, number))
        if points is None:
            return None
        if layer.geometry != "PointZ":
            return drawn_from_above(points, layer.shapes_m[number])
        above = row.get("clearance_m")
        foot = row["height_m"] - (above + (row.get("plate_height_m") or 0.0) / 2 if above is not None else 0.0)
        height = row.get("asset_height_m") or (_HEIGHT_M if above is None else row["height_m"] - foot + _ABOVE_PLATE_M)
        return drawn_from_side(points, (row["easting_m"], row["northing_m"], foot), height)

    def _square(self, rows: Any, number: int) -> str:
        if self._grid is None:
            return ""
        return str(self._grid.squares.tile_at(rows["easting_m"][number].as_py(), rows["northing_m"][number].as_py()))

    def _points_of(self, square: str) -> tuple[Any, Any, Any] | None:
        """Return the classified points of a square, if there are any."""
        record = self._points.get(square)
        if record is None:
            return None
        if square not in self._read:
            with self._session.store.scratch() as folder:
                path = Path(folder) / "points.laz"
                path.write_bytes(read_recorded(self._session.store, record))
                self._read[square] = read_classified(path)
        self._read.move_to_end(square)
        while len(self._read) > _KEPT_SQUARES:
            self._read.popitem(last=False)
        return self._read[square]
