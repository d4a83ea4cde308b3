"""How the clocks of sensors are found: pairs of stamps, or motion that two sensors feel (``[[clocks]]``)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from roadscan.model.strict import Strict


class MotionEvidence(Strict):
    """The clock of a sensor from motion that it shares with one whose clock is right."""

    sensor: str
    """Sensor whose clock is estimated: an IMU or an encoder of the rig."""
    runs: list[str] = []
    """Runs, each with a clock of its own; all where left out."""
    against: str = "trajectory"
    """What feels the same motion on GPS time: "trajectory", or an IMU of the rig."""
    also: list[str] = []
    """Sensors that share this clock (the profiler head an IMU sits in)."""
    search_s: float = Field(default=5.0, gt=0.0, le=3600.0)
    """Largest offset looked for, to both sides (s)."""
    drift: Literal["auto", "none", "estimate"] = "auto"
    """Whether the rate of the clock is estimated; "auto": where the data determine it."""
