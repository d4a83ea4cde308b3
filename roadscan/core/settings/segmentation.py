"""Settings of what tells road readings from others (``roadscan.georeference.road_profiles``, ``.range_filter``)."""

from __future__ import annotations

from pydantic import Field

from roadscan.core.strict import Strict


class SegmentationConfig(Strict):
    """Which readings of a profile count as road; the defaults serve line scanners and triangulation profilers alike."""

    bin_m: float = Field(default=0.02, ge=0.001, le=0.2)
    """Width of the bins of the height histogram (m)."""
    share: float = Field(default=0.4, gt=0.0, le=1.0)
    """Share of its neighbour's count by which a bin still belongs to the road's peak."""
    gate_m: float = Field(default=0.03, gt=0.0, le=0.5)
    """Readings this near to a line agree with it (m)."""
    scatter_factor: float = Field(default=6.0, ge=2.0)
    """How many times the second difference of its neighbours, and the noise, that of a scattered reading is."""
    scatter_readings: int = Field(default=5, ge=1, le=100)
    """Neighbours on each side that it is compared with."""
    grazing_deg: float = Field(default=6.0, ge=0.0, lt=90.0)
    """Least angle between beam and surface (degrees)."""
    chord_m: float = Field(default=0.02, gt=0.0)
    """Least length of the chords that stand for the surface (m): cracks are narrower."""
    step_m: float = Field(default=0.01, gt=0.0, le=0.5)
    """Step (m) that the carriageway goes on over, beside noise: rims of patches and joints."""
    noise_factor: float = Field(default=3.0, ge=0.0)
    """How many standard deviations of the noise are no step."""
    slope: float = Field(default=0.02, ge=0.0, le=1.0)
    """Change of slope over a gap that is no step (m/m)."""
    window_m: float = Field(default=0.3, gt=0.0)
    """Length of road that the line is fitted to (m)."""
    window_readings: int = Field(default=9, ge=3)
    """Fewest readings that it is fitted to."""
    bridge_m: float = Field(default=1.5, gt=0.0)
    """Widest gap that the road is taken to go on behind (m): behind poles, across potholes."""


class RangeFilter(Strict):
    """Settings of the range filter for turns."""

    base_m: float = Field(default=1.0, gt=0.0)
    """Path over which the turn is measured (m)."""
    radius_max_m: float = Field(default=100.0, gt=0.0)
    """A wider turn is none: no scanner reads the road that far (m)."""


class RoadSegmentation(Strict):
    """Profiles are segmented, and only readings that hit the road count in cells, rasters and figures.

    Nothing is deleted: every other reading keeps its class, is counted by it (`roadscan status`) and listed by
    `roadscan classes`; `filters.keep_marked` carries it into the LAS files. An empty table switches it on.
    """

    sensors: list[str] | None = Field(default=None, min_length=1)
    """Sensors of the rig whose profiles are segmented; left out, all those of scans whose profiles lie across the road
    and look down: less than 60° between the profile's normal and the driving direction, and between the sensor's z and
    straight down."""
    profiles: SegmentationConfig = SegmentationConfig()
    """How profiles are segmented."""
    turns: RangeFilter | None = None
    """Switches the range filter for turns on, an empty table with its defaults: on the inner side, readings beyond the
    crossing of successive profiles are `overlapping`. Left out, all of them count."""
