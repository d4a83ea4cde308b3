"""The road of a scene: alignment, shape, wear, and what is painted on it.

*Station* runs along the reference line (m), *offset* is positive to its right (m). Heights are metres, angles degrees.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict, pattern_in_words

Shade = Annotated[float, Field(ge=0, le=255)]
"""Intensity of a surface, in digital numbers of a profiler."""


TARGET_NAME: Final = pattern_in_words(
    r"^[A-Za-z0-9_-]{0,16}$", "up to 16 letters (A–Z, a–z), digits, '_' or '-', or nothing: then it is numbered"
)
"""Names of targets."""


class Element(Strict):
    """A piece of the alignment."""

    kind: Literal["straight", "spiral", "arc"]
    """straight; arc of `radius_m`; spiral: a clothoid from the curvature of the piece before to that of
    the piece after it."""
    length_m: float = Field(gt=0)
    """Length along the reference line (m)."""
    radius_m: float | None = None
    """Radius of an arc, positive when it turns right (m)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.kind == "arc") != (self.radius_m is not None):
            raise ValueError("an arc needs radius_m, and nothing else has one")
        if self.radius_m is not None and abs(self.radius_m) < 20.0:
            raise ValueError(f"radius_m {self.radius_m:g} is tighter than 20 m")
        return self


class GradeChange(Strict):
    """A change of the reference line's grade, rounded by a parabola."""

    station_m: float
    """Middle of the parabola, where the two straight grades would meet (m)."""
    grade: float = Field(ge=-0.15, le=0.15)
    """Rise from here on (m/m)."""
    curve_m: float = Field(default=40.0, ge=2.0)
    """Length of the parabola (m)."""


class CrossSlope(Strict):
    """Fall of the lanes to both sides at a station; between two of them it changes linearly (superelevation)."""

    station_m: float
    """Station (m)."""
    left: float = Field(ge=-0.12, le=0.12)
    """Fall from the reference line to the left (m/m); negative: it rises."""
    right: float = Field(ge=-0.12, le=0.12)
    """Fall from the reference line to the right (m/m)."""


class Wave(Strict):
    """One sine of the longitudinal profile."""

    wavelength_m: float = Field(ge=2.0)
    """Length of the wave along the reference line (m)."""
    amplitude_m: float = Field(ge=0.0)
    """Half the height between trough and crest (m)."""
    phase_deg: float = 0.0
    """Phase at station 0 (degrees)."""


class Roughness(Strict):
    """Random unevenness of the longitudinal profiles: ISO 8608, G(n) = G(n0) · (n / n0)^−w, n0 = 0.1 cycles/m.

    Wavelengths run from 0.7 to 80 m. Profiles at other offsets differ, the more the shorter the wave. They are made at
    offsets at most 0.35 m apart and interpolated between: halfway between two of them, with the default coherence,
    waves of 4 m hold 96 % of their power, waves of 2 m 93 %, waves of 1 m 87 %.
    """

    iso_class: Literal["A", "B", "C", "D", "E"] | None = None
    """Class of ISO 8608: the degree of roughness G(n0) is the class's geometric mean."""
    iri_m_per_km: float | None = Field(default=None, gt=0.0, le=20.0)
    """International Roughness Index of the whole road's mean wheel path, in place of a class (m/km)."""
    waviness: float = Field(default=2.0, ge=1.5, le=3.0)
    """Exponent w."""
    coherence_m: float = Field(default=3.0, gt=0.2)
    """Distance across the road over which waves of 5 m lose their likeness (coherence 1/e; m)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.iso_class is None) == (self.iri_m_per_km is None):
            raise ValueError("give iso_class or iri_m_per_km, one of both")
        return self


class Texture(Strict):
    """Macrotexture of the paved surface: stones and gaps, seen by the profilers; wider beams see its mean."""

    mpd_mm: float = Field(gt=0.0, le=4.0)
    """Mean profile depth, ISO 13473-1:2019 (mm)."""
    grain_mm: float = Field(default=8.0, ge=3.0, le=30.0)
    """Wavelength at which the texture is strongest (mm)."""
    contrast: float = Field(default=6.0, ge=0.0, le=60.0)
    """Standard deviation of the intensity from stone to stone (digital numbers)."""


class Rut(Strict):
    """A wheel path worn down over the whole length of the road."""

    offset_m: float
    """Offset of its deepest line (m)."""
    width_m: float = Field(default=0.7, gt=0.05)
    """Width from edge to edge (m)."""
    depth_m: float = Field(default=0.012, ge=0.0, le=0.2)
    """Mean depth below the unworn surface (m)."""
    variation: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share by which the depth swings along the road."""
    variation_m: float = Field(default=40.0, ge=5.0)
    """Length of that swing (m)."""


class Pothole(Strict):
    """A round hole: depth · (1 − (ρ / radius)⁴)² below the worn surface, or a level floor between steep walls."""

    station_m: float
    """Station of its centre (m)."""
    offset_m: float
    """Offset of its centre (m)."""
    radius_m: float = Field(gt=0.02, le=3.0)
    """Radius of its rim (m)."""
    depth_m: float = Field(gt=0.0, le=0.3)
    """Depth of its centre (m)."""
    wall_m: float = Field(default=0.0, ge=0.0)
    """Width of its walls, seen from above (m): its floor is level within them. 0: the rounded form."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.wall_m > self.radius_m:
            raise ValueError(f"wall_m {self.wall_m:g} is wider than radius_m {self.radius_m:g}")
        return self


class Crack(Strict):
    """An open crack along a broken line: depth · (1 − (distance / half width)²)² below the worn surface, or a slot."""

    points_m: list[tuple[float, float]] = Field(min_length=2)
    """Corners of the line, each a station and an offset (m)."""
    width_m: float = Field(default=0.006, ge=0.001, le=0.1)
    """Width at the surface (m)."""
    depth_m: float = Field(default=0.01, gt=0.0, le=0.1)
    """Depth in the middle (m)."""
    wall_m: float = Field(default=0.0, ge=0.0)
    """Width of each wall, seen from above (m): a slot, whose floor is level within them. 0: the rounded form."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.wall_m > self.width_m / 2:
            raise ValueError(f"wall_m {self.wall_m:g} is wider than half of width_m {self.width_m:g}")
        return self


class Alligator(Strict):
    """A field of alligator cracks: the borders of random cells."""

    station_m: float
    """Station of its middle (m)."""
    offset_m: float
    """Offset of its middle (m)."""
    length_m: float = Field(default=2.0, gt=0.2, le=50.0)
    """Extent along the road (m)."""
    width_m: float = Field(default=0.8, gt=0.2, le=20.0)
    """Extent across the road (m)."""
    cell_m: float = Field(default=0.22, ge=0.08)
    """Mean size of a cell (m)."""
    crack_width_m: float = Field(default=0.005, ge=0.001, le=0.05)
    """Width of its cracks (m)."""
    crack_depth_m: float = Field(default=0.008, gt=0.0, le=0.1)
    """Depth of its cracks (m)."""


class Ravelling(Strict):
    """A place where the surface has lost stones: round holes at random, within an ellipse or a rectangle.

    A hole has the shape of a pothole: depth · (1 − (ρ / radius)⁴)² below the worn surface, and its intensity.
    """

    station_m: float
    """Station of its middle (m)."""
    offset_m: float
    """Offset of its middle (m)."""
    shape: Literal["rectangle", "ellipse"] = "ellipse"
    """Outline; the middles of all holes lie in it."""
    length_m: float = Field(default=2.0, gt=0.05, le=50.0)
    """Extent along the road (m)."""
    width_m: float = Field(default=0.8, gt=0.05, le=20.0)
    """Extent across the road (m)."""
    lost_share: float = Field(default=0.2, gt=0.0, le=0.6)
    """Area of all holes over that of the place, where holes that overlap count twice."""
    stone_m: float = Field(default=0.012, ge=0.004, le=0.04)
    """Mean diameter of a hole (m); diameters are even between 0.7 and 1.3 of it."""
    depth_m: float = Field(default=0.005, gt=0.0, le=0.03)
    """Mean depth of a hole (m), of the same spread."""


class Joints(Strict):
    """Transverse joints at even distances, over the whole paved width."""

    spacing_m: float = Field(gt=0.5)
    """From joint to joint (m)."""
    first_m: float = 0.0
    """Station of one of them (m)."""
    width_m: float = Field(default=0.010, ge=0.001, le=0.1)
    """Width at the surface (m)."""
    depth_m: float = Field(default=0.012, gt=0.0, le=0.1)
    """Depth below the surface (m)."""
    start_m: float = Field(default=float("-inf"), allow_inf_nan=True)
    """First station (m)."""
    end_m: float = Field(default=float("inf"), allow_inf_nan=True)
    """Last station (m)."""


class Slabs(Strict):
    """Concrete slabs over the whole paved width, which stand at different heights: a fault at each joint.

    A slab is tilted: each joint's fault lies half above and half below the worn surface, so that no height adds up.
    """

    start_m: float
    """First joint (m)."""
    end_m: float
    """No joint lies behind this station (m)."""
    length_m: tuple[float, float] = (4.0, 6.0)
    """Shortest and longest slab (m); lengths are even between them. Equal: all of one length."""
    fault_m: tuple[float, float] = (0.002, 0.015)
    """Least and greatest fault (m); faults are even between them, of either sign."""
    gap_m: float = Field(default=0.008, ge=0.001, le=0.1)
    """Width of a joint (m)."""
    depth_m: float = Field(default=0.02, gt=0.0, le=0.1)
    """Depth of a joint (m)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not 1.0 <= self.length_m[0] <= self.length_m[1]:
            raise ValueError(f"length_m {self.length_m}: give the shortest slab, 1 m or more, and the longest")
        if not 0.0 <= self.fault_m[0] <= self.fault_m[1] <= 0.1:
            raise ValueError(f"fault_m {self.fault_m}: give the least fault and the greatest, 0.1 m or less")
        return self


class Hump(Strict):
    """A speed hump or a raised table over the whole width: ramp up, flat top, ramp down."""

    station_m: float
    """Station of its middle (m)."""
    height_m: float = Field(default=0.08, gt=0.0, le=0.3)
    """Height of its top (m)."""
    top_m: float = Field(default=0.0, ge=0.0)
    """Length of the flat top (m)."""
    ramp_m: float = Field(default=1.5, ge=0.8)
    """Length of each ramp (m): at the share x of it, 10 x³ − 15 x⁴ + 6 x⁵ of the height, so that it begins and ends
    without a bend."""


class Patch(Strict):
    """A repaired place, utility cut or manhole cover: a rectangle or circle of other material, sunk or raised.

    One over the whole width is a kerb that is crossed, or a step in the texture.
    """

    station_m: float
    """Station of its middle (m)."""
    offset_m: float
    """Offset of its middle (m)."""
    shape: Literal["rectangle", "circle"] = "rectangle"
    """Outline; a circle's diameter is `length_m` (a manhole, say)."""
    length_m: float = Field(default=2.0, gt=0.1)
    """Extent along the road (m)."""
    width_m: float = Field(default=1.0, gt=0.1)
    """Extent across the road (m)."""
    height_m: float = Field(default=-0.004, ge=-3.0, le=3.0)
    """Height of its surface above the road around it, in its middle (m); negative: sunk. Beside the road: a terrace, a
    bank, a raised bed or a ditch, by its edge."""
    rise_m: float = Field(default=0.0, ge=-0.3, le=0.3)
    """By how much its far end stands higher than its near end (m)."""
    edge_m: float = Field(default=0.03, ge=0.001, le=10.0)
    """Width of the slope along its edge, inside the outline (m); at most half of its shorter extent."""
    shade: Shade = 52.0
    """Intensity."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        extent = self.length_m if self.shape == "circle" else min(self.length_m, self.width_m)
        if self.edge_m > extent / 2:
            raise ValueError(
                f"edge_m {self.edge_m:g} is more than half of the patch's extent of {extent:g} m, so that height_m is "
                f"nowhere reached; give {extent / 2:g} or less"
            )
        return self


class Stain(Strict):
    """An oil stain: an ellipse with a soft edge, in intensity only."""

    station_m: float
    """Station of its middle (m)."""
    offset_m: float
    """Offset of its middle (m)."""
    length_m: float = Field(default=0.6, gt=0.02)
    """Extent along the road (m)."""
    width_m: float = Field(default=0.4, gt=0.02)
    """Extent across the road (m)."""
    shade: Shade = 22.0
    """Intensity in the middle."""


class TyreMark(Strict):
    """A skid mark: a dark band along a broken line, in intensity only."""

    points_m: list[tuple[float, float]] = Field(min_length=2)
    """Corners of its middle line, each a station and an offset (m)."""
    width_m: float = Field(default=0.2, gt=0.02, le=1.0)
    """Width (m)."""
    shade: Shade = 34.0
    """Intensity."""


class Marking(Strict):
    """A painted line along the road: intensity, and a colour in pictures with colours."""

    offset_m: float
    """Offset of its middle (m)."""
    width_m: float = Field(default=0.12, gt=0.0)
    """Width (m)."""
    dash_m: float = Field(default=0.0, ge=0.0)
    """Length of a dash (m); 0: a solid line."""
    gap_m: float = Field(default=0.0, ge=0.0)
    """Length of the gap between dashes (m)."""
    colour: Literal["white", "yellow", "green"] = "white"
    """Colour."""
    worn: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of its paint that is worn off, in flakes of 3 cm."""
    shade: Shade | None = None
    """Its intensity, where it differs from `brightness.marking`."""
    start_m: float = Field(default=float("-inf"), allow_inf_nan=True)
    """First station (m)."""
    end_m: float = Field(default=float("inf"), allow_inf_nan=True)
    """Last station (m)."""


class StopBar(Strict):
    """A painted bar across a lane."""

    station_m: float
    """Station of its middle (m)."""
    from_m: float
    """Offset of its left end (m)."""
    to_m: float
    """Offset of its right end (m)."""
    width_m: float = Field(default=0.5, gt=0.05)
    """Extent along the road (m)."""
    worn: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of its paint that is worn off, in flakes of 3 cm."""


class Symbol(Strict):
    """A symbol painted on a lane."""

    station_m: float
    """Station of its middle (m)."""
    offset_m: float
    """Offset of its middle (m)."""
    shape: Literal["ahead", "left", "right", "ahead_left", "ahead_right", "bicycle", "triangle", "diamond"] = "ahead"
    """What it shows: an arrow by the ways that it allows, a bicycle, or the rim of a triangle or a diamond."""
    facing: Literal["forward", "backward"] = "forward"
    """Who reads it: those who drive with stations, or against them."""
    length_m: float = Field(default=4.0, gt=0.5, le=10.0)
    """Extent along the road (m)."""
    width_m: float = Field(default=0.9, gt=0.3, le=3.5)
    """Extent across the road (m)."""
    line_m: float = Field(default=0.15, gt=0.05, le=0.5)
    """Width of an arrow's shaft (m)."""
    head_m: float = Field(default=1.0, gt=0.1, le=4.0)
    """Length of an arrow's head (m)."""
    worn: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of its paint that is worn off, in flakes of 3 cm."""


class Crosswalk(Strict):
    """A zebra crossing: stripes along the road, side by side."""

    station_m: float
    """Station of its middle (m)."""
    from_m: float
    """Offset of its left end (m)."""
    to_m: float
    """Offset of its right end (m)."""
    length_m: float = Field(default=4.0, gt=0.5)
    """Extent along the road (m)."""
    stripe_m: float = Field(default=0.5, gt=0.05)
    """Width of a stripe (m)."""
    gap_m: float = Field(default=0.5, gt=0.05)
    """Gap between stripes (m)."""
    worn: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of its paint that is worn off, in flakes of 3 cm."""


TargetStyle = Literal["disc", "ring", "checker"]
"""disc: white with a black centre; ring: a black ring around a white disc, on white; checker: 2 × 2 squares, two of
them black."""


class Target(Strict):
    """A painted control target; its middle is surveyed."""

    station_m: float
    """Station of its middle (m)."""
    offset_m: float
    """Offset of its middle (m)."""
    diameter_m: float = Field(default=0.30, gt=0.05, le=2.0)
    """Diameter of the disc; edge of the square of the other styles (m)."""
    centre_m: float = Field(default=0.06, ge=0.0)
    """Diameter of the black centre of a disc (m)."""
    role: Literal["gcp", "check"] = "gcp"
    """Whether the survey states it as a control point or as a check point."""
    style: TargetStyle = "disc"
    """disc: white with a black centre; ring: a black ring, from 0.4 to 0.8 of the square, on white; checker: 2 × 2
    squares, along and across the road, two of them black."""
    name: str = Field(default="", pattern=TARGET_NAME)
    """Name in the survey; made of its role and number where left out."""


class KerbRamp(Strict):
    """A dropped kerb."""

    station_m: float
    """Station of its middle (m)."""
    length_m: float = Field(default=4.0, ge=0.5)
    """Length of the low part (m); both of its ends are moved out to the next half metre of station."""
    transition_m: float = Field(default=1.0, ge=0.5)
    """Length of the slope on each side of it (m); it is made of straight pieces from half metre to half metre, so
    one that is no multiple of 0.5 m ends at the half metre after it."""
    height_m: float = Field(default=0.02, ge=0.0, le=0.3)
    """Height of the low part (m)."""


class Kerb(Strict):
    """A kerb along the edge of the pavement; the verge beyond it is the pavement for pedestrians."""

    side: Literal["left", "right"]
    """Side of the road."""
    height_m: float = Field(default=0.12, gt=0.0, le=0.4)
    """Height of its top above the pavement (m)."""
    face_m: float = Field(default=0.02, ge=0.01, le=0.2)
    """Width of its face, seen from above (m); both sides of a road have the same."""
    ramps: list[KerbRamp] = []
    """Dropped kerbs."""


class Brightness(Strict):
    """Intensity of each material, in digital numbers of a profiler (0–255)."""

    asphalt: Shade = 70.0
    """Asphalt of the lanes."""
    marking: Shade = 190.0
    """Lane markings and other paint."""
    defect: Shade = 38.0
    """Inside potholes and cracks."""
    shoulder: Shade = 78.0
    """Shoulders."""
    verge: Shade = 105.0
    """Verge, or pavement for pedestrians, beside the road."""
    kerb: Shade = 135.0
    """Kerbs."""


class Grass(Strict):
    """Grass on the verge: each beam is stopped somewhere among the blades, or by the soil. Green in pictures."""

    height_m: float = Field(default=0.05, gt=0.0, le=0.6)
    """Height of the blades: 0.03 mown, 0.3 rough (m)."""
    from_m: float = Field(default=0.0, ge=0.0)
    """Where it begins beyond the paved edge: the width of a sidewalk, say (m)."""
    shade: Shade = 85.0
    """Intensity."""


class Road(Strict):
    """The road's surface: a function of station and offset, known everywhere up to the verge's edge."""

    alignment: list[Element] = [Element(kind="straight", length_m=100.0)]
    """Pieces of the reference line from station 0 on, repeated in both directions as far as the road goes."""
    lead_m: float = Field(default=45.0, ge=20.0, le=1000.0)
    """Length of road before station 0 and after the last one (m)."""
    lanes: int = Field(default=2, ge=1, le=12)
    """Number of lanes; the reference line is the middle of them. Lane 1 is the leftmost."""
    lane_width_m: float = Field(default=3.5, ge=2.5, le=60.0)
    """Width of a lane (m)."""
    shoulder_width_m: float = Field(default=0.0, ge=0.0, le=10.0)
    """Width of the paved shoulder on each side (m)."""
    shoulder_slope: float = Field(default=0.04, ge=-0.12, le=0.12)
    """Fall of the shoulders away from the road (m/m)."""
    verge_width_m: float = Field(default=7.0, ge=0.5)
    """Width of the verge beside lanes and shoulders; beyond it there is no surface (m)."""
    verge_slope: float = Field(default=0.07, ge=-0.2, le=0.2)
    """Fall of the verge away from the road (m/m)."""
    kerbs: list[Kerb] = Field(default=[], max_length=2)
    """Kerbs, at most one on each side, at the outer edge of lanes and shoulders."""
    cross_slope: float = Field(default=0.025, ge=-0.12, le=0.12)
    """Fall from the crown to both sides (m/m), where `cross_slopes` says nothing."""
    cross_slopes: list[CrossSlope] = []
    """Falls along the road, in the order of their stations; before the first and after the last they stay."""
    crown_rounding_m: float = Field(default=0.2, gt=0.0)
    """Within this distance of the crown the two sides pass into each other (m)."""
    grade: float = Field(default=0.018, ge=-0.15, le=0.15)
    """Rise along the reference line up to the first of `grades` (m/m)."""
    grades: list[GradeChange] = []
    """Changes of the grade, in the order of their stations."""
    waves: list[Wave] = []
    """Waves on top of the grade."""
    humps: list[Hump] = []
    """Speed humps."""
    roughness: Roughness | None = None
    """Random unevenness."""
    texture: Texture | None = None
    """Macrotexture of lanes and shoulders."""
    ruts: list[Rut] = []
    """Wheel paths."""
    potholes: list[Pothole] = []
    """Potholes; where any of potholes, cracks, lost stones and joints overlap, the deepest counts."""
    cracks: list[Crack] = []
    """Cracks."""
    alligators: list[Alligator] = []
    """Fields of alligator cracks."""
    ravelling: list[Ravelling] = []
    """Places that have lost stones."""
    joints: list[Joints] = []
    """Transverse joints."""
    slabs: list[Slabs] = []
    """Slabs that stand at different heights."""
    patches: list[Patch] = []
    """Patches and utility cuts."""
    repeat_m: float = Field(default=0.0, ge=0.0)
    """Potholes, cracks, alligator cracks, lost stones, patches, stains and tyre marks come again each this many metres
    of station; 0: they do not."""
    markings: list[Marking] = []
    """Lane markings."""
    stop_bars: list[StopBar] = []
    """Stop bars."""
    crosswalks: list[Crosswalk] = []
    """Zebra crossings."""
    symbols: list[Symbol] = []
    """Arrows and other symbols."""
    targets: list[Target] = []
    """Painted control targets; with the plates of the roadside they are the survey's control points where there are
    any."""
    grass: Grass | None = None
    """Grass on the verge; bare where left out."""
    stains: list[Stain] = []
    """Oil stains."""
    tyre_marks: list[TyreMark] = []
    """Tyre marks."""
    brightness: Brightness = Brightness()
    """Intensities."""

    @property
    def half_width_m(self) -> float:
        """Distance from the reference line to the lanes' edge (m)."""
        return self.lanes * self.lane_width_m / 2

    @property
    def paved_m(self) -> float:
        """Distance from the reference line to the outer edge of the shoulder, where a kerb stands (m)."""
        return self.half_width_m + self.shoulder_width_m

    @property
    def edge_m(self) -> float:
        """Distance from the reference line to the outer edge of the verge (m)."""
        return self.paved_m + self.verge_width_m

    def lane_offset_m(self, lane: int) -> float:
        """Return the offset of the middle of lane `lane`, counted from 1 at the left (m)."""
        return (lane - (self.lanes + 1) / 2) * self.lane_width_m

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.alignment:
            raise ValueError("alignment is empty: give at least one straight, arc or spiral")
        tightest = min((abs(e.radius_m) for e in self.alignment if e.radius_m is not None), default=float("inf"))
        if tightest < 1.5 * self.edge_m:
            raise ValueError(
                f"an arc of {tightest:g} m is too tight for a road that reaches {self.edge_m:g} m from its reference "
                "line (1.5 times that is the limit)"
            )
        if self.crown_rounding_m > self.half_width_m / 2:
            raise ValueError("crown_rounding_m is more than half of the lanes' half width")
        if len({kerb.side for kerb in self.kerbs}) < len(self.kerbs):
            raise ValueError("two kerbs on one side")
        if len({kerb.face_m for kerb in self.kerbs}) > 1:
            raise ValueError("the kerbs of both sides need the same face_m")
        for name, listed in (("cross_slopes", self.cross_slopes), ("grades", self.grades)):
            stations = [one.station_m for one in listed]
            if stations != sorted(set(stations)):
                raise ValueError(f"{name} are not in the order of their stations")
        return self
