"""Pictures as they are, or without what Matplotlib does to draw them: that takes half of a short survey's adjustment.

All that roadscan puts on a figure is put there either way, and a file of the figure's size is written.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from PIL import Image

_DRAW = Figure.savefig


def _leave_blank(figure: Figure, target: Path, **_: Any) -> None:
    width, height = (figure.get_size_inches() * figure.dpi).round().astype(int)
    Image.new("L", (int(width), int(height)), 255).save(target, "PNG")


@contextmanager
def blank() -> Iterator[None]:
    """Pictures are left blank."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", _leave_blank)
        yield


@contextmanager
def drawn() -> Iterator[None]:
    """Pictures are drawn, also inside :func:`blank`: for what looks at them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", _DRAW)
        yield
