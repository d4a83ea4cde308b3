# ruff: noqa: T201
"""A spinning lidar's returns from above, out of the store.

python top_view.py PICTURE.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

import roadscan


def main(picture: Path) -> None:
    """Draw the returns of one turn by their laser number."""
    survey = roadscan.open_survey("hdl32e.toml")
    turns = (
        "SELECT sweep, count(*) AS returns, count(DISTINCT laser) AS lasers FROM returns GROUP BY sweep ORDER BY sweep"
    )
    print(survey.sql(turns).df().to_string(index=False))
    draw(survey.sql("SELECT * FROM returns WHERE sweep = 1").df(), picture)


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
