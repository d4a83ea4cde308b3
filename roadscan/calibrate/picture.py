"""Draws a calibration: changes of the mountings, their σ, and the residuals."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.calibrate.estimator import Calibrated, Calibration, Figures
from roadscan.calibrate.rotations import logarithm
from roadscan.core.canvas import empty_figure, save_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LEVER: Final = ("forward", "right", "down")
_ANGLES: Final = ("roll", "pitch", "heading")
_COLOURS: Final = ("#1f5fa8", "#d1495b", "#2e8b3d", "#e07a00", "#7b2d8b", "#555555")
_HELD: Final = 0.9
"""A direction with σ above this share of the prior's is not determined."""


@dataclass(frozen=True)
class SensorChange:
    """Change of a sensor's mounting: six numbers each, lever arm (m), then boresight (rad)."""

    change: npt.NDArray[np.float64]
    sigma: npt.NDArray[np.float64]
    prior_sigma: npt.NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationPicture:
    """The content of the picture, which can be stored as JSON and drawn again."""

    title: str
    undetermined: tuple[str, ...]
    """Directions that the evidence does not determine, in words."""
    sensors: dict[str, SensorChange]
    figures: tuple[Figures, ...]

    @classmethod
    def of(cls, calibration: Calibration, title: str) -> CalibrationPicture:
        """Collect the content for a calibration."""
        sensors = {n: SensorChange(_change(one), one.sigma, one.prior_sigma) for n, one in calibration.sensors.items()}
        return cls(title, tuple(calibration.observability.undetermined), sensors, calibration.figures)

    def as_values(self) -> dict[str, Any]:
        """Return the content as numbers, texts and lists."""
        sensors = {n: {k: v.tolist() for k, v in vars(one).items()} for n, one in self.sensors.items()}
        figures = [asdict(one) for one in self.figures]
        return {"title": self.title, "undetermined": self.undetermined, "sensors": sensors, "figures": figures}

    @classmethod
    def of_values(cls, values: dict[str, Any]) -> CalibrationPicture:
        """Rebuild the content; the inverse of :meth:`as_values`."""
        sensors = {n: SensorChange(**{k: np.array(v) for k, v in s.items()}) for n, s in values["sensors"].items()}
        figures = tuple(Figures(**one) for one in values["figures"])
        return cls(values["title"], tuple(values["undetermined"]), sensors, figures)


def draw_calibration(path: Path, calibration: CalibrationPicture) -> None:
    """Write one PNG; the same calibration gives the same bytes.

    Above, the change of each lever arm and boresight with 1 σ, and the prior 1 σ as a grey band: hollow where the
    evidence does not determine it. Below, RMS of the residuals before and after.
    """
    figure = empty_figure(13.0, 9.0, 110)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.2, 1.0])
    held = calibration.undetermined
    words = "all mountings determined" if not held else "not determined: " + "; ".join(held[:4])
    figure.suptitle(f"{calibration.title}, calibration\n{words}", fontsize=10, x=0.01, ha="left")
    _draw_changes(figure.add_subplot(grid[0, 0]), calibration, slice(0, 3), 1e3, "mm", _LEVER)
    _draw_changes(figure.add_subplot(grid[0, 1]), calibration, slice(3, 6), 180.0 / np.pi, "°", _ANGLES)
    _draw_residuals(figure.add_subplot(grid[1, :]), calibration)
    save_whole(figure, path)


def _draw_changes(
    axes: Axes, calibration: CalibrationPicture, part: slice, scale: float, unit: str, names: tuple[str, ...]
) -> None:
    count = max(len(calibration.sensors), 1)
    for number, (sensor, one) in enumerate(calibration.sensors.items()):
        x = np.arange(3) + (number - (count - 1) / 2) * 0.7 / count
        colour = _COLOURS[number % len(_COLOURS)]
        change, sigma, prior = (scale * v[part] for v in (one.change, one.sigma, one.prior_sigma))
        axes.bar(x, 2 * prior, bottom=-prior, width=0.6 / count, color="#dddddd", zorder=0)
        for k in range(3):
            is_held = sigma[k] > _HELD * prior[k]
            axes.errorbar(
                x[k], change[k], yerr=sigma[k], fmt="o", color=colour, capsize=4,
                markerfacecolor="white" if is_held else colour,
                label=sensor if k == 0 else None,
            )  # fmt: skip
            axes.annotate(
                f"{change[k]:+.3g} ± {sigma[k]:.2g}", (x[k], change[k]), xytext=(5, 5),
                textcoords="offset points", fontsize=7, color=colour,
            )  # fmt: skip
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set_xticks(np.arange(3), names)
    axes.set_ylabel(f"change against the rig file ({unit}); grey: prior 1 σ")
    axes.set_title("Lever arms" if unit == "mm" else "Boresights", fontsize=10)
    axes.legend(fontsize=8)


def _draw_residuals(axes: Axes, calibration: CalibrationPicture) -> None:
    shown = [f for f in calibration.figures if f.count]
    y = np.arange(len(shown))[::-1]
    before = np.array([max(f.rms_before, 1e-3) for f in shown])
    after = np.array([max(f.rms_after, 1e-3) for f in shown])
    axes.barh(y + 0.2, before, height=0.35, color="#bbbbbb", label="with the rig file's mountings")
    axes.barh(y - 0.2, after, height=0.35, color=_COLOURS[0], label="calibrated")
    for place, one in zip(y, shown, strict=True):
        axes.annotate(_words(one), (max(one.rms_before, 1e-3), place + 0.2), xytext=(4, -3),
                      textcoords="offset points", fontsize=7)  # fmt: skip
    axes.axvline(1.0, color="black", linewidth=0.6)
    if shown:
        axes.set_xscale("log")
    axes.set_yticks(y, [f"{f.kind}\n{f.sensors}" for f in shown], fontsize=7)
    axes.set_xlabel("RMS of the residuals over their σ (1: as stated)")
    axes.set_title("Residuals by kind of evidence", fontsize=10)
    axes.margins(x=0.25)
    axes.legend(fontsize=8, loc="lower right")


def _words(one: Figures) -> str:
    text = f"{one.count:,} observations, {one.rejected:,} rejected"
    if one.rms_before_m is not None and one.rms_after_m is not None:
        text += f"; {1e3 * one.rms_before_m:.3g} → {1e3 * one.rms_after_m:.3g} mm"
    return text


def _change(one: Calibrated) -> np.ndarray:
    """Return the change (6,), m and rad, from the rig file's mounting to the calibrated one."""
    (before, lever), (after, arm) = one.before.arrays(), one.mounting.arrays()
    return np.concatenate([arm - lever, logarithm(after @ before.T)])
