"""How the vehicle of a scene moves: passes, speeds, stops, suspension."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict


class Stop(Strict):
    """The vehicle brakes to a standstill, waits, and drives on."""

    at_m: float = Field(ge=0.0)
    """Where, as metres driven since the first profile (m)."""
    duration_s: float = Field(gt=0.0, le=3600.0)
    """How long it stands (s)."""


class SpeedChange(Strict):
    """Another mean speed from here on."""

    at_m: float = Field(ge=0.0)
    """Where, as metres driven since the first profile (m)."""
    speed_m_per_s: float = Field(gt=0.5, le=50.0)
    """Mean speed from there on (m/s)."""


class RoutePiece(Strict):
    """A piece of a route: a straight, or an arc."""

    length_m: float = Field(gt=0)
    """Length (m)."""
    radius_m: float | None = None
    """Radius of an arc, positive when it turns right (m); left out for a straight."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.radius_m is not None and abs(self.radius_m) < 5.0:
            raise ValueError(f"radius_m {self.radius_m:g} is tighter than a car can turn (5 m)")
        return self


class Route(Strict):
    """A free path over the surface, in place of a lane: loops of a calibration yard, turns, reversing.

    The curvature passes from piece to piece over `ease_m`, as a driver turns the wheel.
    """

    station_m: float
    """Station at the start (m)."""
    offset_m: float
    """Offset at the start (m)."""
    heading_deg: float = 0.0
    """Direction of travel at the start, from that of the road, clockwise (degrees)."""
    pieces: list[RoutePiece] = Field(min_length=1)
    """Pieces of the path, one after another."""
    ease_m: float = Field(default=6.0, ge=1.0)
    """Length over which the curvature changes from piece to piece (m)."""
    reverse: bool = False
    """Drive it backwards: the body looks against the direction of travel."""


class PassScene(Strict):
    """One traverse of a lane, or of a free route, recorded as one run."""

    lane: int = Field(default=1, ge=1)
    """Lane that is driven, counted from 1 at the left."""
    direction: Literal["forward", "backward"] = "forward"
    """forward: towards growing stations."""
    offset_m: float = Field(default=0.0, ge=-5.0, le=5.0)
    """Shift of the path from the middle of the lane, right positive along growing stations (m)."""
    route: Route | None = None
    """A free path, in place of the lane."""
    speed_m_per_s: float | None = Field(default=None, gt=0.5, le=50.0)
    """Mean speed; the vehicle's own where left out (m/s)."""
    speeds: list[SpeedChange] = []
    """Changes of the mean speed, in the order driven."""
    stops: list[Stop] = []
    """Stops, in the order driven."""


class Vehicle(Strict):
    """How the vehicle moves."""

    speed_m_per_s: float = Field(default=13.9, gt=0.5, le=50.0)
    """Mean speed (m/s)."""
    speed_variation: float = Field(default=0.06, ge=0.0, le=0.3)
    """Relative variation of the speed."""
    acceleration_m_per_s2: float = Field(default=1.5, ge=0.3, le=5.0)
    """Acceleration and braking at stops and changes of speed (m/s²)."""
    imu_height_m: float = Field(default=0.95, gt=0.0)
    """IMU reference point above the road, along the body's down axis (m)."""
    wander_m: float = Field(default=0.10, ge=0.0, le=0.5)
    """The driver's wander about the middle of the lane (m)."""
    heave_m: float = Field(default=0.004, ge=0.0, le=0.05)
    """Amplitude of the suspension's vertical motion (m)."""
    sway_deg: float = Field(default=0.25, ge=0.0, le=10.0)
    """Amplitude of the suspension's roll and pitch (degrees)."""
    lean_deg_per_m_per_s2: float = Field(default=0.0, ge=0.0, le=3.0)
    """Roll to the outside of a turn, and pitch when braking, for each m/s² (degrees)."""
    standstill_s: float = Field(default=0.0, ge=0.0, le=600.0)
    """Standing still, engine on, before the run-up and after the run-out of each pass (s); the trajectory, IMU, GNSS
    and encoder record it."""
