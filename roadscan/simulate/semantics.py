"""Semantic classes of what beams meet: of each kind of object, of single bodies of it, and of places on the ground."""

from __future__ import annotations

from typing import Final

CLASSES: Final = (
    "noise", "road", "parking", "sidewalk", "terrain", "kerb", "marking", "building", "wall", "fence", "hedge",
    "vegetation", "trunk", "pole", "sign", "signal", "vehicle", "person", "furniture", "wire",
)  # fmt: skip
"""Names of the classes, by number. Noise: on no object (drops, mirrored beams, false returns); sidewalk: paved verge;
terrain: verge that is not paved; kerb: its face and top; furniture: all smaller things that stand in a street."""

CLASS_OF_KIND: Final = {
    "sign": "pole", "pole": "pole", "lamp_post": "pole", "signal": "signal", "tree": "vegetation",
    "planting": "vegetation", "hedge": "hedge", "fence": "fence", "gate": "fence", "guardrail": "fence", "wall": "wall",
    "facade": "building", "overhead": "building", "box": "furniture", "cover": "road", "drain": "road", "wire": "wire",
    "door": "building", "balcony": "building", "steps": "building", "shop_sign": "building", "barrier": "fence",
    "person": "person",
    "parked_car": "vehicle", "moving_car": "vehicle", "car": "vehicle", "van": "vehicle", "lorry": "vehicle",
    "bicycle": "vehicle", "motorcycle": "vehicle",
}  # fmt: skip
"""Class of an object by its kind; of what moves without "moving_"; kinds that are not here are furniture."""


def class_number(name: str) -> int:
    """Return the number of a class."""
    return CLASSES.index(name)


def class_of_kind(kind: str) -> int:
    """Return the number of the class of an object's kind."""
    return class_number(CLASS_OF_KIND.get(kind.removeprefix("moving_") if kind != "moving_car" else kind, "furniture"))


TRUNK: Final = class_number("trunk")
SIGN: Final = class_number("sign")
WALL: Final = class_number("wall")
POLE: Final = class_number("pole")
VEGETATION: Final = class_number("vegetation")
PERSON: Final = class_number("person")
