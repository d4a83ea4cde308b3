# ruff: noqa: T201
"""A spinning lidar's returns from above, read out of the store's Parquet files by DuckDB alone.

python top_view.py PICTURE.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import duckdb
import pandas as pd

RETURNS = "store/survey=hdl32e/tables/returns/*/*/*/*/*.parquet"


def main(picture: Path) -> None:
    """Draw the returns of one turn by their laser number."""
    table = duckdb.sql(f"FROM read_parquet('{RETURNS}')")
    turns = table.aggregate("sweep, count(*) AS returns, count(DISTINCT laser) AS lasers", "sweep").order("sweep")
    print(turns.df().to_string(index=False))
    draw(table.filter("sweep = 1").df(), picture)


def draw(returns: pd.DataFrame, picture: Path) -> None:
    """One turn from above."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 5.6), layout="constrained")
    shown = axes.scatter(returns.x_sensor_m, returns.y_sensor_m, s=1.5, c=returns.laser, cmap="turbo", linewidths=0)
    axes.plot(0, 0, "+", color="black")
    axes.set(xlabel="forward (m)", ylabel="left (m)", aspect="equal", xlim=(-40, 40), ylim=(-40, 40))
    figure.colorbar(shown, ax=axes, label="laser")
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
