"""Classes of what stands in a simulated street: by an object's kind, and where kerbs and paint are on its ground."""

from __future__ import annotations

from typing import Final

from roadscan.compute.array_types import Bool, Float64
from roadscan.simulate.bodies import class_number
from roadscan.simulate.kernels.ground import kerb_height
from roadscan.simulate.kernels.options import compiled
from roadscan.simulate.kernels.road import ITEMS, ITEMS_END, STATION, RoadArrays, is_worn, node_at

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

SHAFTS: Final = ("", "pole", "lighting", "signal", "tree", "delineator", "post")
"""Types of shafts by number: none, five that the stage finds, and a pole of a type that nobody knows."""
SHAFT_OF_KIND: Final = {"sign": "pole", "pole": "pole", "lamp_post": "lighting", "signal": "signal", "tree": "tree",
                        "bollard": "delineator"}  # fmt: skip
"""Type of the shaft of an object by its kind; low poles are delineators."""


def class_of_kind(kind: str) -> int:
    """Return the number of the class of an object's kind."""
    return class_number(CLASS_OF_KIND.get(kind.removeprefix("moving_") if kind != "moving_car" else kind, "furniture"))


@compiled
def kerb_heights(road: RoadArrays, station: Float64, offset: Float64, out: Float64) -> None:
    """Write the height of the kerb on the side of places (m); 0: none. All arrays (n,)."""
    for i in range(station.size):
        k = node_at(road, station[i])
        out[i] = kerb_height(road, k, station[i] - road.nodes[k, STATION], offset[i])


@compiled
def find_paint(road: RoadArrays, station: Float64, offset: Float64, out: Bool) -> None:
    """Write whether places are on paint that is not worn off: lines, stop bars, zebra crossings. All arrays (n,)."""
    nodes, lines, items = road.nodes, road.lines, road.items
    for p in range(station.size):
        s, o = station[p], offset[p]
        found = False
        for i in range(lines.shape[0]):
            if abs(o - lines[i, 0]) <= lines[i, 1] and lines[i, 4] <= s <= lines[i, 5]:
                is_dash = lines[i, 3] == 0.0 or s % lines[i, 3] < lines[i, 2]
                found = found or (is_dash and not is_worn(lines[i, 6], s, o))
        k = node_at(road, s)
        for i in range(int(nodes[k, ITEMS]), int(nodes[k, ITEMS_END])):
            inside = items[i, 0] == 0.0 and abs(s - items[i, 2]) <= items[i, 4] and abs(o - items[i, 3]) <= items[i, 5]
            found = found or (inside and not is_worn(items[i, 6], s, o))
        out[p] = found
