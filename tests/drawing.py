"""Pictures as they are, or without what draws them: half of a short survey's adjustment, a tenth of any run.

All that roadscan puts on a figure is put there either way, and a file of the figure's size is written. The report's
small pictures of products and of the map are one white pixel.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from roadscan.report.sections import made
from roadscan.site import thumbnail

_DRAWN = {(Figure, "savefig"): Figure.savefig, (made, "_small_picture"): made._small_picture,
          (thumbnail, "_ground"): thumbnail._ground}  # fmt: skip


def _leave_blank(figure: Figure, target: Path, **_: Any) -> None:
    width, height = (figure.get_size_inches() * figure.dpi).round().astype(int)
    Image.new("L", (int(width), int(height)), 255).save(target, "PNG")


def _white_pixel(*_: Any) -> bytes:
    stream = io.BytesIO()
    Image.new("L", (1, 1), 255).save(stream, "PNG")
    return stream.getvalue()


def _white(_: Any, __: Any, ___: Any, shape: tuple[int, int]) -> Any:
    return np.full((*shape, 3), 255, np.uint8)


_BLANK = dict(zip(_DRAWN, (_leave_blank, _white_pixel, _white), strict=True))


@contextmanager
def _with(functions: dict[Any, Any]) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for (place, name), function in functions.items():
            patch.setattr(place, name, function)
        yield


def blank() -> Any:
    """Pictures are left blank."""
    return _with(_BLANK)


def drawn() -> Any:
    """Pictures are drawn, also inside :func:`blank`: for what looks at them."""
    return _with(_DRAWN)
