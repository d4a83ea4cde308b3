"""Returns of a square with their classes, as LAZ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.classes import CLASS_NAMES
from roadscan.assets.returns import Returns
from roadscan.assets.scene import Box
from roadscan.core.grid import QUANTA_PER_M, TileGrid, TileId
from roadscan.georeference.cloud import TilePoints
from roadscan.tiles.product import ProductContext
from roadscan.tiles.products.las import LasOptions, write_las

_OWN_CODES: Final = {code: name for code, name in CLASS_NAMES.items() if code >= 64}
"""LAS leaves the meaning of these codes to the file, which names them."""


def classified_points(returns: Returns, classes: npt.NDArray[np.uint8], square: TileId, tile: Box) -> TilePoints:
    """Returns returns (n,) of a square as points, each with its class (n,); `tile` is the square as they have it."""
    values = (returns.x_m, tile.x_min_m), (returns.y_m, tile.y_min_m), (returns.height_m, 0.0)
    quanta = [(np.rint(v * QUANTA_PER_M) - round(first * QUANTA_PER_M)).astype(np.int32) for v, first in values]
    return TilePoints(
        tile=square,
        x_quanta=quanta[0],
        y_quanta=quanta[1],
        height_quanta=quanta[2],
        epoch_gps_ns=returns.epoch_gps_ns,
        intensity=np.clip(np.rint(returns.intensity), 0, 65535).astype(np.uint16),
        classification=classes,
        pass_id=returns.pass_id,
        extra={"return_number": returns.return_number, "number_of_returns": returns.number_of_returns},
    )


def write_classified(path: Path, points: TilePoints, squares: TileGrid, context: ProductContext) -> None:
    """Write the points of a square (one or more) as LAZ, with the names of the user-defined classes."""
    codes, counts = np.unique(points.classification, return_counts=True)
    facts = {
        "survey": context.survey_id,
        "square": str(points.tile),
        "height": context.map.height,
        "classes": {str(code): int(count) for code, count in zip(codes.tolist(), counts.tolist(), strict=True)},
    }
    write_las(path, points, LasOptions(scale_m=1e-3), replace(context, grid=squares), facts, _OWN_CODES)
