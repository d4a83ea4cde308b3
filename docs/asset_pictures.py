"""Writes docs/pictures/assets-street.png: what is found on a simulated town street, over its bare earth.

python docs/asset_pictures.py [FOLDER]

FOLDER holds a simulated survey whose assets were found before; without it a street is simulated and run.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import geopandas
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import rasterio
from matplotlib.axes import Axes
from matplotlib.colors import LightSource

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.bench_assets import simulated
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.store.asset_schema import asset_schema, asset_tables
from roadscan.survey.run import run_stages

PICTURE: Final = Path(__file__).resolve().parent / "pictures" / "assets-street.png"
POINTS: Final = "os^vDPX*"


def main(arguments: list[str]) -> None:
    """Draw every kind that was found."""
    mpl.use("Agg")
    if arguments:
        draw(Session.open(Path(arguments[0]) / "SURVEY.toml"))
        return
    with tempfile.TemporaryDirectory() as folder:
        session = simulated(Path(folder))
        run_stages(session, [stage_named("assets")])
        draw(session)


def draw(session: Session) -> None:
    """Write the picture of a survey's assets."""
    figure, axis = plt.subplots(figsize=(11, 11), layout="constrained")
    store = session.store
    for path in store.files("products/bare_earth"):
        shade(axis, store.path(path))
    tables = {name: geopandas.read_parquet(store.path(f"products/assets/{name}.parquet")) for name in asset_tables()
              if store.exists(f"products/assets/{name}.parquet")}  # fmt: skip
    held = {name: table for name, table in tables.items() if len(table)}
    for number, (name, table) in enumerate(held.items()):
        show(axis, table, number, f"{asset_schema(asset_tables()[name]).title} ({len(table)})")
    every = np.array([table.total_bounds for table in held.values()])
    west, south = every[:, :2].min(axis=0) - 5.0
    east, north = every[:, 2:].max(axis=0) + 5.0
    axis.set(xlim=(west, east), ylim=(south, north), aspect="equal", xlabel="easting (m)", ylabel="northing (m)")
    axis.legend(fontsize=9, loc="best")
    figure.savefig(PICTURE, dpi=90, metadata={"Software": "roadscan"})


def show(axis: Axes, table: Any, number: int, title: str) -> None:
    """One kind, in a colour and shape of its own."""
    colour = plt.get_cmap("tab20")(number % 20)
    flat = table.geometry.force_2d()
    if flat.geom_type.iloc[0] == "Point":
        axis.scatter(flat.x, flat.y, s=40, color=colour, marker=POINTS[number % len(POINTS)], edgecolors="k",
                     linewidths=0.5, label=title, zorder=3)  # fmt: skip
    else:
        lines = flat.boundary if flat.geom_type.iloc[0] == "Polygon" else flat
        drawn = lines.where(~lines.is_empty, flat)
        drawn.plot(ax=axis, color=colour, linewidth=1.8, label=title)


def shade(axis: Axes, path: str) -> None:
    """Bare earth of a square in slanting light; holes are light."""
    with rasterio.open(path) as raster:
        seen, bridged, _ = raster.read()
        b = raster.bounds
        if np.isnan(bridged).all():
            return
        cell = raster.res[0]
        light = LightSource(315, 35).hillshade(np.nan_to_num(bridged, nan=np.nanmedian(bridged)), 5.0, cell, cell)
    light = np.where(np.isnan(seen), np.where(np.isnan(bridged), np.nan, 0.55 + 0.45 * light), light)
    axis.imshow(light, cmap="gray", vmin=0.0, vmax=1.0, extent=(b.left, b.right, b.bottom, b.top), alpha=0.6)


if __name__ == "__main__":
    main(sys.argv[1:])
