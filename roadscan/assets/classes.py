"""Classes of returns: ASPRS LAS 1.4 as far as it goes, and codes of our own from 64 on."""

from __future__ import annotations

from typing import Final

NEVER_CLASSIFIED: Final = 0
UNCLASSIFIED: Final = 1
GROUND: Final = 2
LOW_VEGETATION: Final = 3
MEDIUM_VEGETATION: Final = 4
HIGH_VEGETATION: Final = 5
BUILDING: Final = 6
LOW_NOISE: Final = 7
ROAD: Final = 11
WIRE: Final = 14
BRIDGE_DECK: Final = 17
HIGH_NOISE: Final = 18
OVERHEAD_STRUCTURE: Final = 19
POLE: Final = 64
SIGN: Final = 65
KERB: Final = 66
BARRIER: Final = 67
MARKING: Final = 68
VEHICLE: Final = 69
PERSON: Final = 70
FENCE: Final = 71
SIDEWALK: Final = 72

CLASS_NAMES: Final = {
    NEVER_CLASSIFIED: "never classified",
    UNCLASSIFIED: "unclassified",
    GROUND: "ground",
    LOW_VEGETATION: "low vegetation",
    MEDIUM_VEGETATION: "medium vegetation",
    HIGH_VEGETATION: "high vegetation",
    BUILDING: "building",
    LOW_NOISE: "low point (noise)",
    ROAD: "road surface",
    WIRE: "wire conductor",
    BRIDGE_DECK: "bridge deck",
    HIGH_NOISE: "high noise",
    OVERHEAD_STRUCTURE: "overhead structure",
    POLE: "pole",
    SIGN: "sign",
    KERB: "kerb",
    BARRIER: "barrier",
    MARKING: "marking",
    VEHICLE: "vehicle",
    PERSON: "person",
    FENCE: "fence",
    SIDEWALK: "sidewalk",
}
"""Codes up to 19 are those of the ASPRS LAS 1.4 R15 table 17; those from 64 on are left to users by that table."""
