"""Creates Matplotlib figures. Matplotlib takes most of a second to import, so only functions that draw load it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def empty_figure(width_in: float, height_in: float, dots_per_inch: int) -> Figure:
    """Return an empty figure that needs no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=dots_per_inch, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_whole(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file, which appears when it is whole."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        figure.savefig(part, format="png", metadata={"Software": None})
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
