"""Figure of the residuals of a camera: their mean in each part of the picture, and histograms before and after."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from roadscan.adjust.bundle.outcome import PictureOutcome
from roadscan.compute.array_types import Float64
from roadscan.core.canvas import empty_figure

_CELLS: Final = (16, 10)  # Columns and rows of the map.
_LEAST: Final = 4  # Measurements of a cell whose mean is shown.
_BEFORE: Final = "#d1495b"
_AFTER: Final = "#1f5fa8"


@dataclass(frozen=True)
class CameraResiduals:
    """Residuals of one camera's tie points that count."""

    camera: str
    size_px: tuple[int, int]
    pixel: Float64
    """(m, 2)"""
    before_px: Float64
    """(m, 2)"""
    after_px: Float64
    """(m, 2)"""


def residuals_of(found: PictureOutcome) -> Iterator[CameraResiduals]:
    """Yields the residuals of each camera, by name."""
    measured = found.measured
    cameras = measured.exposures.cameras
    of = np.array([cameras[k].sensor for k in measured.exposures.camera[measured.picture].tolist()])
    sound = np.isfinite(found.before_px).all(axis=1) & np.isfinite(found.after_px).all(axis=1)
    sound &= measured.is_tie & (found.weight > 0.0)
    for name in sorted(set(of.tolist())):
        rows = sound & (of == name)
        interior = next(camera.rig.interior for camera in cameras if camera.sensor == name)
        if rows.any() and interior is not None:
            size = interior.width_px, interior.height_px
            yield CameraResiduals(name, size, measured.pixel[rows], found.before_px[rows], found.after_px[rows])


def draw_residuals(shown: CameraResiduals, path: Path) -> None:
    """Draw the map of mean residuals and the histograms. Equal input gives equal bytes."""
    figure = empty_figure(11.0, 4.2, 120)
    figure.suptitle(f"tie points of {shown.camera}: {len(shown.pixel):,} measurements")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    place, mean = _means(shown)
    longest = float(np.hypot(*mean.T).max(initial=0.0))
    if len(place):
        left.quiver(*place.T, *mean.T, angles="xy", color=_AFTER)
    left.set_xlim(0, shown.size_px[0])
    left.set_ylim(shown.size_px[1], 0)
    left.set_aspect("equal")
    left.set_title(f"mean of each part after the adjustment; longest {longest:.2f} px")
    limit = max(float(np.percentile(np.abs(shown.before_px), 95)), 0.5)
    edges = np.linspace(-limit, limit, 41)
    for values, colour, word in ((shown.before_px, _BEFORE, "before"), (shown.after_px, _AFTER, "after")):
        rms = float(np.sqrt(np.mean(values**2)))
        inside = np.clip(values.ravel(), -limit, limit)
        right.hist(inside, edges.tolist(), color=colour, alpha=0.6, label=f"{word}: RMS {rms:.2f} px")
    right.set_xlabel("measured minus computed (px)")
    right.legend(fontsize="small")
    figure.savefig(path, metadata={"Software": None})


def _means(shown: CameraResiduals) -> tuple[Float64, Float64]:
    """Returns middles (k, 2) of the cells with enough measurements, and their mean residuals (k, 2)."""
    columns, rows = _CELLS
    step = np.array(shown.size_px) / np.array([columns, rows])
    cell = np.clip((shown.pixel / step).astype(np.int64), 0, [columns - 1, rows - 1])
    number = cell[:, 1] * columns + cell[:, 0]
    count = np.bincount(number, minlength=columns * rows)
    sums = np.stack([np.bincount(number, v, minlength=columns * rows) for v in shown.after_px.T], axis=-1)
    kept = np.flatnonzero(count >= _LEAST)
    middle = np.stack([kept % columns + 0.5, kept // columns + 0.5], axis=-1) * step
    return middle, sums[kept] / count[kept][:, None]
