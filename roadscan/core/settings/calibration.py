"""How mountings are calibrated: evidence (``[[calibration]]``) and its settings (``[navigation.calibration]``)."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict

# Three σ: larger than 10 m or 10° says nothing.
_Sigma3 = tuple[
    Annotated[float, Field(ge=0.0, le=10.0)],
    Annotated[float, Field(ge=0.0, le=10.0)],
    Annotated[float, Field(ge=0.0, le=10.0)],
]


class Area(Strict):
    """A rectangle of the map; what lies outside is left out of this evidence."""

    easting_min_m: float
    """West side (map coordinates, m)."""
    northing_min_m: float
    """South side (m)."""
    easting_max_m: float
    """East side (m)."""
    northing_max_m: float
    """North side (m)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.easting_max_m <= self.easting_min_m or self.northing_max_m <= self.northing_min_m:
            raise ValueError("the area is empty: each max has to be greater than its min")
        return self


class OverlapEvidence(Strict):
    """A surface that was driven over more than once: loops, back-through and right-angle loops, strips that overlap."""

    kind: Literal["overlap"]
    """"overlap"."""
    sensors: list[str] = Field(min_length=1)
    """Sensors of the rig that saw it; each is tied to itself in other traverses and to the others."""
    runs: list[str] = []
    """Runs that drove over it; all where left out."""
    passes: list[int] = []
    """Passes that drove over it, in place of whole runs."""
    area: Area | None = None
    """Only readings within it; each time the vehicle comes by is a separate drive, so that loops of one run are kept
    apart. Where left out, each run (or pass) is one drive, and all that overlaps counts."""


class ObjectEvidence(Strict):
    """Sensor to sensor: a calibration object of known shape, seen by two or more sensors."""

    kind: Literal["object"]
    """"object"."""
    sensors: list[str] = Field(min_length=1)
    """Sensors of the rig that saw it."""
    steps: list[tuple[float, float, float]] = Field(min_length=1)
    """Its shape, a stepped block: length, width, and height of the top above the ground, of each step (m), all about
    one middle. One step is a plain block."""
    easting_m: float
    """About where its middle lies on the map (m): within 0.3 m."""
    northing_m: float
    """About where its middle lies on the map (m)."""
    heading_deg: float = 0.0
    """About which way its length points, clockwise from the map's north (degrees): within 8."""
    sigma_m: float = Field(default=0.0002, gt=0.0)
    """1 σ of the object's surface, as it was made or measured (m)."""
    runs: list[str] = []
    """Runs that drove over it; all where left out."""
    passes: list[int] = []
    """Passes that drove over it, in place of whole runs."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(min(step) <= 0.0 for step in self.steps):
            raise ValueError("each step needs a length, a width and a height above 0")
        return self


class StopAndGoEvidence(Strict):
    """The IMU inside a sensor's head against the trajectory: gravity while standing, acceleration while driving."""

    kind: Literal["stop_and_go"]
    """"stop_and_go"."""
    sensor: str
    """Sensor whose orientation is found."""
    imu: str
    """IMU of the rig that sits in its head; the rig file states how the two are turned to each other."""
    runs: list[str] = []
    """Runs that stop and go; all with this IMU where left out."""


class ReferenceEvidence(Strict):
    """A mobile scan against a scan of known place (a terrestrial scanner's), by iterative closest points."""

    kind: Literal["reference"]
    """"reference"."""
    sensor: str
    """Sensor of the rig whose scan is compared with it."""
    path: Path
    """The reference scan (LAS, LAZ, PLY, E57), relative to the survey file."""
    format: str | None = None
    """Format name (`roadscan formats`); found from the bytes where left out."""
    crs: str
    """CRS of its coordinates, such as "EPSG:25832" or "local"; never assumed."""
    height: Literal["ellipsoidal", "orthometric"]
    """Kind of its heights; never assumed."""
    geoid: str | None = None
    """Geoid grid of orthometric heights, where they must become ellipsoidal."""
    options: dict[str, Any] = {}
    """Settings of the format (`roadscan formats NAME`)."""
    runs: list[str] = []
    """Runs that passed it; all where left out."""


CalibrationEvidence = Annotated[
    OverlapEvidence | ObjectEvidence | StopAndGoEvidence | ReferenceEvidence,
    Field(discriminator="kind"),
]
"""One source of evidence; `kind` says which."""


class CalibrationSettings(Strict):
    """What all evidence of a calibration shares."""

    lever_arm_sigma_m: _Sigma3 = (0.05, 0.05, 0.05)
    """1 σ of lever arms (forward, right, down) of sensors whose rig file states none: a careful tape measure (m)."""
    boresight_sigma_deg: _Sigma3 = (1.5, 1.5, 1.5)
    """1 σ of boresights (roll, pitch, heading) of sensors whose rig file states none (degrees)."""
    range_offset_sigma_m: dict[str, float] = {}
    """Sensors whose ranges may have a constant error, with its 1 σ (m); it is estimated for them, and for no others."""
    traverse_sigma_m: _Sigma3 = (0.02, 0.02, 0.03)
    """1 σ of the poses' position (north, east, down) where the trajectory states none (m)."""
    traverse_sigma_deg: _Sigma3 = (0.01, 0.01, 0.03)
    """1 σ of the poses' roll, pitch, heading where the trajectory states none (degrees)."""
    traverse_time_constant_s: float = Field(default=60.0, gt=0.0)
    """Errors of poses this far apart are correlated by 1/e (s)."""
    traverse_piece_s: float = Field(default=2.0, gt=0.0)
    """Within so long the error of poses counts as constant (s)."""
    robust_limit: float = Field(default=2.5, gt=1.0)
    """Residuals beyond this many σ count less the larger they are (Huber)."""
    reject_limit: float = Field(default=6.0, gt=2.0)
    """Ties beyond this many σ do not count at all, and are listed by kind."""
    independent_ties: float = Field(default=10_000.0, ge=10.0)
    """A kind of evidence counts at most as so many independent ties: neighbouring readings share errors of surface,
    matching and pose, which a million of them do not average out."""
    determined_below: float = Field(default=0.3, gt=0.0, lt=1.0)
    """A direction counts as determined where the evidence alone gives it a σ below this share of its prior σ. Others
    keep their prior value."""
    margin_m: float = Field(default=0.3, ge=0.0)
    """Readings so far outside an area are looked at too: the mountings of the rig file may be wrong by that (m)."""
    iterations_max: int = Field(default=40, ge=1, le=1000)
    """Linearisations for one set of ties."""
    rounds_max: int = Field(default=20, ge=1, le=200)
    """How often ties are found anew with better mountings."""
    valid_from: dt.datetime | None = None
    """From when the mountings hold, with zone (2026-05-04T09:30:00Z); from the beginning where left out."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.reject_limit <= self.robust_limit:
            raise ValueError(f"reject_limit {self.reject_limit:g} has to lie above robust_limit {self.robust_limit:g}")
        if self.valid_from is not None and self.valid_from.tzinfo is None:
            raise ValueError("valid_from needs a time zone, such as 2026-05-04T09:30:00Z")
        return self
