"""How far the figures of two runs over one road differ, in their own σ."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import duckdb
import numpy as np
import pandas as pd

MOST_SIGMA: Final = 3.0
"""A difference of so many σ of both figures is allowed."""
MOST_SHARE: Final = 0.01
"""So many of the cells may differ by more, be missing or be new: edges of what a sensor sees move."""
LEAST_READINGS: Final = 3
"""Cells with fewer readings are not compared."""

_CELLS: Final = """
    SELECT parse_filename(filename) AS tile, "row", "column", height_robust_m AS height, height_std_m AS spread, count
    FROM read_parquet('{}/tiles/cells/*.parquet', filename = true) WHERE count >= {}
"""
_SIGMA: Final = (
    ("mri_m_per_km", "sigma_mri_m_per_km"),
    ("rut_depth_mean_left_mm", "sigma_rut_depth_mean_mm"),
    ("rut_depth_mean_right_mm", "sigma_rut_depth_mean_mm"),
    ("cross_slope_mean_percent", "sigma_cross_slope_mean_percent"),
)
"""Figures of sections, each with its σ."""


@dataclass(frozen=True)
class Products:
    """What a run wrote: cells, σ of the tiles' poses, figures of sections."""

    cells: pd.DataFrame
    sigma_down_m: pd.Series[float]
    """By name of the tile's file."""
    sections: pd.DataFrame

    @classmethod
    def read(cls, store: Path) -> Products | None:
        """The products of a survey in its folder of the store; None where there is no tile."""
        if not list(store.glob("tiles/cells/*.parquet")):
            return None
        cells = duckdb.sql(_CELLS.format(store, LEAST_READINGS)).df().set_index(["tile", "row", "column"])
        tiles = pd.read_parquet(store / "products/tile_table/tiles.parquet")
        sigma = tiles.assign(tile=tiles.tile + ".parquet").set_index("tile").sigma_down_m
        found = sorted(store.glob("products/condition_sections/*.parquet"))
        return cls(cells, sigma, pd.concat(map(pd.read_parquet, found)) if found else pd.DataFrame())


def differences(clean: Products, other: Products) -> Iterator[str]:
    """What differs by more than σ allows, in words."""
    both = clean.cells.add_suffix("_clean").join(other.cells, how="inner")
    lost = 1.0 - len(both) / len(clean.cells)
    new = 1.0 - len(both) / len(other.cells)
    if lost > MOST_SHARE:
        yield f"{lost:.1%} of the cells are missing"
    if new > MOST_SHARE:
        yield f"{new:.1%} of the cells are new"
    if both.empty:
        return
    poses = np.zeros(len(both))
    for one in (clean, other):
        poses += both.index.get_level_values("tile").map(one.sigma_down_m).to_numpy(float) ** 2
    noise = both.spread_clean**2 / both["count_clean"] + both.spread**2 / both["count"]
    away = both.height - both.height_clean
    far = np.abs(away) > MOST_SIGMA * np.sqrt(poses + noise)
    if far.mean() > MOST_SHARE:
        most_mm, sigma_mm = 1e3 * np.percentile(np.abs(away), 95), 1e3 * np.sqrt(np.median(poses))
        yield (
            f"{far.mean():.1%} of the heights differ by more than {MOST_SIGMA:g} σ: 95 % within {most_mm:.2f} mm, σ of "
            f"poses {sigma_mm:.2f} mm"
        )
    yield from _sections(clean.sections, other.sections)


def _sections(clean: pd.DataFrame, other: pd.DataFrame) -> Iterator[str]:
    keys = ["road", "lane", "station_from_m"]
    if clean.empty:
        return
    if other.empty:
        yield "there are no figures of sections"
        return
    both = clean.merge(other, on=keys, how="left", suffixes=("_clean", ""))
    for name, sigma in _SIGMA:
        gone = both[f"{name}_clean"].notna() & both[name].isna()
        if gone.any():
            yield f"{name} is missing in {int(gone.sum())} of {len(both)} sections"
        allowed = MOST_SIGMA * np.hypot(both[f"{sigma}_clean"].to_numpy(), both[sigma].to_numpy())
        away = (both[name] - both[f"{name}_clean"]).abs().to_numpy()
        if (away > allowed).any():
            worst = int(np.nanargmax(away / allowed))
            yield f"{name} differs by {away[worst]:.3g}, allowed {allowed[worst]:.3g}"
