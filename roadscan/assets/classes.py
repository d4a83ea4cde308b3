"""Classes of returns: ASPRS LAS 1.4 where it has them, and user-defined codes from 64 on."""

from __future__ import annotations

from typing import Final

NEVER_CLASSIFIED: Final = 0  # LAS 1.4
UNCLASSIFIED: Final = 1  # LAS 1.4
GROUND: Final = 2  # LAS 1.4
LOW_VEGETATION: Final = 3  # LAS 1.4
MEDIUM_VEGETATION: Final = 4  # LAS 1.4
HIGH_VEGETATION: Final = 5  # LAS 1.4
BUILDING: Final = 6  # LAS 1.4
LOW_NOISE: Final = 7  # LAS 1.4
ROAD: Final = 11  # LAS 1.4
WIRE: Final = 14  # LAS 1.4
BRIDGE_DECK: Final = 17  # LAS 1.4
HIGH_NOISE: Final = 18  # LAS 1.4
OVERHEAD_STRUCTURE: Final = 19  # LAS 1.4
POLE: Final = 64  # user-defined
SIGN: Final = 65  # user-defined
KERB: Final = 66  # user-defined
BARRIER: Final = 67  # user-defined
MARKING: Final = 68  # user-defined
VEHICLE: Final = 69  # user-defined
PERSON: Final = 70  # user-defined
FENCE: Final = 71  # user-defined
SIDEWALK: Final = 72  # user-defined
FURNITURE: Final = 73  # user-defined
VEGETATION: Final = (LOW_VEGETATION, MEDIUM_VEGETATION, HIGH_VEGETATION)

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
    FURNITURE: "furniture",
}
"""Codes up to 19 are those of the ASPRS LAS 1.4 R15 table 17; those from 64 on are left to users by that table."""
