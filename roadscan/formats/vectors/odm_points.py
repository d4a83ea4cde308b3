"""Places of control points in pictures, of OpenDroneMap: the pixels of gcp_list.txt."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import Field

from roadscan.core.strict import Strict
from roadscan.formats.vectors.odm_gcp import OdmGcp, odm_rows
from roadscan.formats.vectors.picture_points import BY_HAND, RawPoints, point_items
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.records import options_of


class OdmPointsOptions(Strict):
    """Settings of `odm_picture_points`."""

    sigma_px: float | None = Field(default=None, gt=0.0)
    """1 σ of each coordinate of all points (pixels); not stated where left out."""


class OdmPoints(LogFormat):
    """Where the points of OpenDroneMap's list are in pictures: the columns of x and y in the picture of each line.

    Pixels count from the centre of the upper left one, as OpenSfM, which reads these lists, counts them. Points are
    named as `odm_gcp` names them, which reads their positions from the same file; so this format has to be stated. A
    point whose height is NaN is read: it needs none.
    """

    name = "odm_picture_points"
    title = "OpenDroneMap's places of control points in pictures (gcp_list.txt)"
    yields = ("picture_points",)
    time = "holds no time"
    options = OdmPointsOptions

    def sniff(self, path: Path) -> bool:
        """Never: the same file is `odm_gcp`, and the survey file says which part of it is meant."""
        return False

    def header(self, source: LogSource) -> LogHeader:
        """Check that it is such a list."""
        source.need_file()
        OdmGcp.need_list(source.path)
        return LogHeader({})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream measurements; a line that is none is rejected."""
        sigma = options_of(source, OdmPointsOptions).sigma_px
        for row in odm_rows(source.path):
            if isinstance(row, Reject):
                yield row
                continue
            yield from point_items(
                RawPoints(
                    np.array([row.record]), np.array([row.offset]), [None], [None], [row.picture], [row.point],
                    np.array([[row.u_px], [row.v_px]]), np.array([np.nan if sigma is None else sigma]), [BY_HAND],
                )
            )  # fmt: skip
