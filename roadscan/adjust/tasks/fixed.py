"""Findings and lines on runs that are fixed (`adjust.fixed`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from roadscan.adjust.fixed_runs import FixedRun
from roadscan.core.witness import Finding, Witness

FIXED_RUN: Final = Witness(
    "fixed_run",
    input="runs",
    fault="A run that is held fixed does not lie where its σ says.",
    asks="ties to other runs and control: the corrections that the run would have if it were not held, against the σ "
    "of its poses and the quantile of adjust.control.false_alarm",
    does="it is held all the same, other runs are adjusted to it, and their σ hold what contradicts it",
    told=("findings",),
)
_WORDS: Final = {
    "north_m": "to the north", "east_m": "to the east", "down_m": "down", "roll_rad": "of roll",
    "pitch_rad": "of pitch", "heading_rad": "of heading",
}  # fmt: skip


def fixed_findings(fixed: Sequence[FixedRun], false_alarm: float) -> list[Finding]:
    """Returns findings on runs that are fixed though other evidence contradicts them."""
    found = []
    for one in fixed:
        off = one.contradicted(false_alarm)
        if off:
            told = ", ".join(f"{_size(name, error)} {_WORDS[name]} ({sigmas:.1f} σ)" for name, error, sigmas in off)
            text = (
                f"it is held fixed, and other evidence puts its poses up to {told} from where they were recorded; "
                "other runs are adjusted to it, and their σ hold the difference"
            )
            found.append(FIXED_RUN.finds(f"run '{one.run}'", text))
    return found


def _size(component: str, value: float) -> str:
    return f"{1e3 * value:+.1f} mm" if component.endswith("_m") else f"{np.degrees(value):+.4f}°"


def fixed_line(fixed: Sequence[FixedRun]) -> str:
    """Returns which runs are fixed; "" where none is."""
    names = ", ".join(one.run for one in fixed)
    return f"held fixed, with poses as they were recorded: {names}" if fixed else ""
