"""What stands and moves beside and on the road of a scene. Everything here blocks beams.

Things stand at a station and an offset of the road, upright, turned with it. Lengths are metres.
"""

from __future__ import annotations

from typing import Literal, Self, TypeAlias

from pydantic import Field, model_validator

from roadscan.core.strict import Strict
from roadscan.simulate.scene.road import TARGET_NAME, Shade, TargetStyle

SignColour: TypeAlias = Literal["white", "red", "blue", "yellow", "green", "brown", "orange", "black"]


class Standing(Strict):
    """Something at one place of the road, or at many."""

    station_m: float
    """Station (m)."""
    offset_m: float
    """Offset (m)."""
    every_m: float = Field(default=0.0, ge=0.0)
    """It comes again each this many metres of station; 0: it stands alone."""
    count: int = Field(default=1, ge=1, le=10_000)
    """How many of them, where `every_m` is given."""


class Sign(Standing):
    """A traffic sign: a plate on a post."""

    shape: Literal["round", "rectangle", "triangle", "octagon", "diamond"] = "rectangle"
    """Outline of the plate; a triangle has equal sides and stands on one of them, a diamond on a corner."""
    width_m: float = Field(default=0.6, gt=0.1, le=10.0)
    """Width of the plate, or its diameter (m)."""
    height_m: float = Field(default=0.6, gt=0.1, le=6.0)
    """Height of a rectangular plate (m); that of others follows from the width."""
    clearance_m: float = Field(default=2.2, ge=0.0, le=8.0)
    """From the ground to the plate's lower edge (m)."""
    faces: Literal["forward", "backward"] = "backward"
    """Whom it faces: backward is read by traffic towards growing stations."""
    shade: Shade = 250.0
    """Intensity of the plate's face (retroreflecting)."""
    back_shade: Shade = 90.0
    """Intensity of its back."""
    colour: SignColour = "white"
    """Colour of the face, in pictures with colours."""
    rim: SignColour | None = None
    """Colour of a rim around it."""
    text: str = Field(default="", max_length=12)
    """Text on the face (ASCII)."""
    face: str = ""
    """File of a picture of the face (PNG, JPEG) that fills the plate's box, in place of colour, rim and text."""


class TargetPlate(Standing):
    """An upright control target: a square plate, on a post or before a wall; its middle is surveyed."""

    size_m: float = Field(default=0.30, gt=0.05, le=2.0)
    """Edge of the plate (m)."""
    height_m: float = Field(default=1.5, gt=0.1, le=30.0)
    """Height of its middle above the ground (m)."""
    style: TargetStyle = "ring"
    """disc: white with a black centre of a fifth; ring: a black ring, from 0.4 to 0.8 of the plate, on white; checker:
    2 × 2 squares, two of them black."""
    faces: Literal["forward", "backward", "road"] = "backward"
    """Whom it faces: backward is read by traffic towards growing stations, road looks across to the reference line."""
    turned_deg: float = Field(default=0.0, ge=-180.0, le=180.0)
    """Turn of the plate from there, clockwise from above (degrees)."""
    post: bool = True
    """Whether it is on a post; without one it hangs where it is, before a wall."""
    role: Literal["gcp", "check"] = "gcp"
    """Whether the survey states it as a control point or as a check point."""
    name: str = Field(default="", pattern=TARGET_NAME)
    """Name in the survey; made of its role and number where left out."""
    shade: Shade = 200.0
    """Intensity of its white parts; the black ones have a twelfth of it."""


class Pole(Standing):
    """A post, a mast, a bollard."""

    height_m: float = Field(default=4.0, gt=0.1, le=30.0)
    """Height (m)."""
    diameter_m: float = Field(default=0.1, gt=0.01, le=2.0)
    """Diameter (m)."""
    shade: Shade = 120.0
    """Intensity."""


class LampPost(Standing):
    """A lamp post with an arm over the road."""

    height_m: float = Field(default=8.0, gt=1.0, le=30.0)
    """Height of the arm (m)."""
    diameter_m: float = Field(default=0.16, gt=0.02, le=1.0)
    """Diameter of the post (m)."""
    arm_m: float = Field(default=1.5, ge=0.0, le=6.0)
    """Length of the arm towards the reference line (m)."""
    is_double: bool = False
    """True: it has the same arm away from the road."""
    shade: Shade = 110.0
    """Intensity."""


class Signal(Standing):
    """A traffic signal: a post with a head of three lamps, or an arm over the road with a head at its end."""

    height_m: float = Field(default=3.4, gt=1.0, le=12.0)
    """Height of the post, and of the arm (m)."""
    diameter_m: float = Field(default=0.12, gt=0.02, le=1.0)
    """Diameter of the post (m)."""
    arm_m: float = Field(default=0.0, ge=0.0, le=8.0)
    """Length of the arm towards the reference line (m); 0: the head is on the post."""
    head_m: tuple[float, float, float] = (0.35, 0.30, 0.95)
    """Width, depth and height of the head (m); its upper edge is level with the post's top."""
    faces: Literal["forward", "backward"] = "backward"
    """Whom it faces: backward is read by traffic towards growing stations."""
    shade: Shade = 100.0
    """Intensity of post and arm."""
    head_shade: Shade = 40.0
    """Intensity of the head."""


class Tree(Standing):
    """A tree: a trunk and a crown that lets some beams through."""

    height_m: float = Field(default=8.0, gt=1.0, le=40.0)
    """Height (m)."""
    trunk_m: float = Field(default=0.35, gt=0.02, le=2.0)
    """Diameter of the trunk (m)."""
    crown_m: float = Field(default=4.5, gt=0.2, le=20.0)
    """Diameter of the crown (m)."""
    density: float = Field(default=0.8, gt=0.0, le=1.0)
    """Share of beams that the crown stops on each of its sides."""
    shade: Shade = 95.0
    """Intensity of the leaves."""
    lean_deg: float = Field(default=0.0, ge=0.0, le=45.0)
    """How far the trunk leans from the vertical (degrees) …"""
    lean_towards_deg: float = 0.0
    """… and whereto, from the direction of the road, clockwise (degrees)."""
    stems: int = Field(default=1, ge=1, le=6)
    """Stems into which it is forked."""
    fork_m: float = Field(default=0.0, ge=0.0, le=5.0)
    """Height of the fork where it has more than one; 0: from the ground (m)."""
    extinction_per_m: float = Field(default=0.0, ge=0.0, le=20.0)
    """The crown stops beams within, with this extinction (1/m); 0: on its outside, by `density`."""
    crown_from_m: float | None = Field(default=None, ge=0.0)
    """Height of the crown's lower end (m); from height and crown where left out."""
    bush_m: float = Field(default=0.0, ge=0.0, le=6.0)
    """Diameter of a bush around the trunk's foot; 0: none (m)."""
    trunk_shade: Shade | None = None
    """Intensity of the trunk; 0.8 of that of the leaves where left out."""


class ParkedCar(Standing):
    """A parked car: body, cabin, wheels."""

    length_m: float = Field(default=4.4, gt=1.0, le=20.0)
    """Length (m)."""
    width_m: float = Field(default=1.8, gt=0.5, le=3.0)
    """Width (m)."""
    height_m: float = Field(default=1.5, gt=0.5, le=5.0)
    """Height (m)."""
    heading_deg: float = 0.0
    """Direction from that of the road, clockwise (degrees)."""
    shade: Shade = 160.0
    """Intensity of the body."""


class Vehicle(Standing):
    """A vehicle that stands: with windows, number plates that shine, and lights."""

    what: Literal["car", "van", "lorry", "bicycle", "motorcycle"] = "car"
    """Kind."""
    size_m: tuple[float, float, float] | None = None
    """Length, width and height (m); those of its kind where left out."""
    heading_deg: float = 0.0
    """Direction from that of the road, clockwise (degrees)."""
    glass: float = Field(default=0.45, gt=0.0, le=1.0)
    """Share of beams that a window stops, to glare, to return weakly, to mirror or to lose them; the rest pass."""
    form: int = Field(default=0, ge=0, le=60)
    """Which of the forms of its kind: height of the waist, length of the roof, what is on the rear."""
    shade: Shade = 160.0
    """Intensity of the body."""


class Person(Standing):
    """A person who stands."""

    height_m: float = Field(default=1.75, gt=0.6, le=2.2)
    """Height (m)."""
    heading_deg: float = 0.0
    """Direction from that of the road, clockwise (degrees)."""
    form: int = Field(default=0, ge=0, le=60)
    """Which stride, and whether with a rucksack."""
    shade: Shade = 100.0
    """Intensity of the clothes."""


class MovingCar(Strict):
    """What moves along the road at constant speed while a pass is recorded: a car, another vehicle, a person."""

    what: Literal["plain", "car", "van", "lorry", "bicycle", "motorcycle", "person"] = "plain"
    """Kind; plain: a car of six boxes."""
    glass: float = Field(default=0.45, gt=0.0, le=1.0)
    """Share of beams that its windows stop, but for a plain car, which has none."""
    form: int = Field(default=0, ge=0, le=60)
    """Which of the forms of its kind."""

    passes: list[int] = []
    """Passes during which it drives, counted from 1; all of them where empty."""
    station_m: float
    """Station at the first profile of each pass (m)."""
    offset_m: float
    """Offset (m)."""
    speed_m_per_s: float
    """Speed, negative towards falling stations (m/s)."""
    length_m: float = Field(default=4.4, gt=1.0, le=20.0)
    """Length (m)."""
    width_m: float = Field(default=1.8, gt=0.5, le=3.0)
    """Width (m)."""
    height_m: float = Field(default=1.5, gt=0.5, le=5.0)
    """Height (m)."""
    shade: Shade = 170.0
    """Intensity of the body."""


class Barrier(Strict):
    """Something long that follows the road."""

    offset_m: float
    """Offset of the side that faces the road (m)."""
    start_m: float
    """First station (m)."""
    end_m: float
    """Last station (m)."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.end_m <= self.start_m:
            raise ValueError(f"end_m {self.end_m:g} is not beyond start_m {self.start_m:g}")
        return self


class Guardrail(Barrier):
    """A steel rail on posts."""

    height_m: float = Field(default=0.75, gt=0.2, le=2.0)
    """Height of the rail's upper edge (m)."""
    rail_m: float = Field(default=0.31, gt=0.05, le=1.0)
    """Height of the rail itself (m)."""
    post_every_m: float = Field(default=2.0, gt=0.5)
    """From post to post (m)."""
    shade: Shade = 180.0
    """Intensity."""


class Fence(Barrier):
    """A fence that lets some beams through."""

    height_m: float = Field(default=1.4, gt=0.2, le=5.0)
    """Height (m)."""
    density: float = Field(default=0.4, gt=0.0, le=1.0)
    """Share of beams that it stops."""
    what: Literal["fence", "gate"] = "fence"
    """Kind."""
    style: Literal["mesh", "pickets", "panels"] = "mesh"
    """A mesh stops beams by chance, pickets by where they are; panels stop all, whatever `density` says."""
    picket_m: float = Field(default=0.09, gt=0.01, le=0.5)
    """Width of a picket (m); the gaps follow from `density`."""
    post_every_m: float = Field(default=0.0, ge=0.0)
    """From post to post; 0: none (m)."""
    shade: Shade = 110.0
    """Intensity."""


class Facade(Barrier):
    """The front of a row of buildings, with windows that mirror beams away."""

    height_m: float = Field(default=9.0, gt=1.0, le=100.0)
    """Height (m)."""
    storey_m: float = Field(default=3.0, gt=2.0, le=6.0)
    """Height of a storey (m)."""
    window_m: float = Field(default=1.2, ge=0.0, le=4.0)
    """Width and height of a window (m); 0: none."""
    bay_m: float = Field(default=3.2, gt=0.5, le=12.0)
    """From window to window (m)."""
    depth_m: float = Field(default=8.0, gt=0.5, le=60.0)
    """Depth of the buildings away from the road (m)."""
    glass: float = Field(default=0.0, ge=0.0, le=1.0)
    """Share of beams that the windows, then with frames, stop to glare, return weakly, mirror or lose them; the rest
    pass into rooms. 0: windows without frames mirror all beams away."""
    room_m: float = Field(default=3.5, gt=0.5, le=20.0)
    """Depth of the rooms behind such windows (m)."""
    shade: Shade = 140.0
    """Intensity."""


class Wall(Barrier):
    """A wall: of a garden, of a terrace, of blocks."""

    height_m: float = Field(default=1.0, gt=0.05, le=8.0)
    """Height above the ground at its road side (m)."""
    thickness_m: float = Field(default=0.25, gt=0.02, le=2.0)
    """Thickness away from the road (m)."""
    shade: Shade = 120.0
    """Intensity."""


class Hedge(Barrier):
    """A hedge, trimmed flat: each beam is stopped somewhere within, or passes."""

    height_m: float = Field(default=1.4, gt=0.1, le=6.0)
    """Height (m)."""
    width_m: float = Field(default=0.8, gt=0.1, le=5.0)
    """Width away from the road (m)."""
    passing: float = Field(default=0.05, gt=0.0, lt=1.0)
    """Share of the beams that pass when they cross its width at right angles."""
    ragged_m: float = Field(default=0.0, ge=0.0, le=1.0)
    """How much its height and its sides vary from metre to metre; 0: trimmed (m)."""
    foot_wall_m: float = Field(default=0.0, ge=0.0, le=2.0)
    """Height of a wall at its foot; 0: none (m)."""
    shade: Shade = 95.0
    """Intensity of the leaves."""


class Box(Standing):
    """A plain box: a calibration object, a cabinet, a step of known height."""

    length_m: float = Field(gt=0.005, le=50.0)
    """Extent along the road (m)."""
    width_m: float = Field(gt=0.005, le=50.0)
    """Extent across the road (m)."""
    height_m: float = Field(gt=0.001, le=30.0)
    """Height above the ground at its middle (m)."""
    heading_deg: float = 0.0
    """Turned from the direction of the road, clockwise (degrees)."""
    shade: Shade = 150.0
    """Intensity."""


class Overhead(Standing):
    """A level slab over the road: the deck of a bridge, a footbridge, a gantry; its piers are boxes."""

    length_m: float = Field(gt=0.05, le=100.0)
    """Extent along the road (m)."""
    width_m: float = Field(gt=0.05, le=100.0)
    """Extent across the road (m)."""
    clearance_m: float = Field(default=5.0, gt=1.5, le=30.0)
    """Height of its lower face above the ground at its middle (m)."""
    thickness_m: float = Field(default=0.9, gt=0.05, le=10.0)
    """From its lower face to its upper one (m)."""
    heading_deg: float = 0.0
    """Turned from the direction of the road, clockwise (degrees)."""
    shade: Shade = 130.0
    """Intensity."""


class Planting(Standing):
    """A bed of low plants: tufts side by side, each of which lets some beams through."""

    length_m: float = Field(gt=0.2, le=200.0)
    """Extent along the road (m)."""
    width_m: float = Field(gt=0.2, le=50.0)
    """Extent across the road (m)."""
    height_m: float = Field(default=0.4, gt=0.02, le=3.0)
    """Height of the tallest tufts; the lowest are half as tall (m)."""
    tuft_m: float = Field(default=0.5, ge=0.1, le=2.0)
    """From tuft to tuft (m)."""
    density: float = Field(default=0.7, gt=0.0, le=1.0)
    """Share of beams that a tuft stops on each of its sides."""
    shade: Shade = 110.0
    """Intensity."""


class Furniture(Standing):
    """A piece of street furniture, or what is fixed to the front of a house (which stands at `offset_m`)."""

    what: Literal[
        "cabinet", "bin", "litter_bin", "bench", "hydrant", "bus_shelter", "bollard", "advertising_column", "billboard",
        "letter_box", "parking_meter", "planter", "sandwich_board", "steps", "door", "balcony", "shop_sign",
        "hanging_sign",
    ]  # fmt: skip
    """Kind. Signs of shops are no traffic signs."""
    heading_deg: float = 0.0
    """Turned from how it faces the road, clockwise (degrees)."""
    scale: float = Field(default=1.0, ge=0.4, le=2.5)
    """Its size over that of its kind."""
    shade: Shade = 110.0
    """Intensity."""


class Cover(Standing):
    """A manhole's cover or a drain's grate: it lies on the road, as that falls."""

    what: Literal["cover", "drain"] = "cover"
    """Kind: a cover is round, a drain rectangular."""
    length_m: float = Field(default=0.62, gt=0.1, le=2.0)
    """Extent along the road, a diameter (m)."""
    width_m: float = Field(default=0.62, gt=0.1, le=2.0)
    """Extent across the road (m)."""
    height_m: float = Field(default=0.003, gt=0.0, le=0.05)
    """How far it stands out (m)."""
    shade: Shade = 110.0
    """Intensity."""


class Wire(Standing):
    """An overhead wire between two places, with sag."""

    to_station_m: float
    """Station of its other end (m)."""
    to_offset_m: float
    """Offset of its other end (m)."""
    height_m: float = Field(default=6.5, gt=1.0, le=40.0)
    """Height of its first end above the ground (m)."""
    to_height_m: float = Field(default=6.5, gt=1.0, le=40.0)
    """Height of its other end above the ground (m)."""
    sag_m: float = Field(default=0.4, ge=0.0, le=5.0)
    """How far its middle hangs below the straight line (m)."""
    diameter_m: float = Field(default=0.02, gt=0.002, le=0.2)
    """Diameter (m)."""
    shade: Shade = 70.0
    """Intensity."""


class Roadside(Strict):
    """Everything that stands and moves."""

    signs: list[Sign] = []
    """Traffic signs."""
    poles: list[Pole] = []
    """Poles."""
    lamp_posts: list[LampPost] = []
    """Lamp posts."""
    trees: list[Tree] = []
    """Trees."""
    parked_cars: list[ParkedCar] = []
    """Parked cars."""
    moving_cars: list[MovingCar] = []
    """Moving cars."""
    guardrails: list[Guardrail] = []
    """Guardrails."""
    fences: list[Fence] = []
    """Fences."""
    facades: list[Facade] = []
    """Fronts of buildings."""
    boxes: list[Box] = []
    """Boxes."""
    signals: list[Signal] = []
    """Traffic signals."""
    overheads: list[Overhead] = []
    """Bridges and gantries."""
    plantings: list[Planting] = []
    """Beds of plants."""
    vehicles: list[Vehicle] = []
    """Vehicles that stand, with windows and bright plates."""
    persons: list[Person] = []
    """People who stand."""
    walls: list[Wall] = []
    """Walls."""
    hedges: list[Hedge] = []
    """Hedges."""
    furniture: list[Furniture] = []
    """Street furniture and parts of house fronts."""
    covers: list[Cover] = []
    """Covers and drains."""
    wires: list[Wire] = []
    """Overhead wires."""
    targets: list[TargetPlate] = []
    """Upright control targets."""
