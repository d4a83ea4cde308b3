"""Points of a survey's LAS tiles as a table, read with laspy: nothing of roadscan takes part."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pandas as pd

GPS_MINUS_ADJUSTED_S = 1_000_000_000


def read_points(survey: Path, names: tuple[str, ...] = ()) -> pd.DataFrame:
    """All points of a survey.

    Parameters
    ----------
    survey : folder ``<store>/survey=<id>``.
    names : further LAS dimensions, taken over as they are.

    Returns
    -------
    Columns x, y, z (map, in its unit), gps_s (GPS seconds since 1980-01-06) and `names`.
    """
    parts = []
    for path in sorted(survey.glob("tiles/las/*.la[sz]")):
        tile = laspy.read(path)
        columns = {axis: np.asarray(tile[axis]) for axis in "xyz"}
        columns["gps_s"] = np.asarray(tile.gps_time) + GPS_MINUS_ADJUSTED_S
        parts.append(pd.DataFrame(columns | {name: np.asarray(tile[name]) for name in names}))
    return pd.concat(parts, ignore_index=True)
