"""Trajectories that NovAtel's SPAN receivers write as ASCII: INSPVAX, INSPVA, INSPVAS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import FormatError
from roadscan.core.strict import Strict
from roadscan.formats.motion.novatel_messages import (
    FIELDS,
    FIELDS_OF_SHORT,
    counted_messages,
    epochs_ns,
    message_blocks,
)
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import gps_clock
from roadscan.ingest.reading.poses import GeodeticPlacement, PoseReader, RawPoses, check_rph, ned_from_rph
from roadscan.ingest.reading.records import Sieve, options_of
from roadscan.ingest.reading.text_table import TextBlock

SOLVED: Final = frozenset({"INS_SOLUTION_GOOD", "INS_ALIGNMENT_COMPLETE", "INS_SOLUTION_FREE", "INS_HIGH_VARIANCE"})
"""Inertial solution status of poses: before, the INS aligns."""
_SIGMAS: Final = {
    "sigma_north_m": "sigma_latitude", "sigma_east_m": "sigma_longitude", "sigma_down_m": "sigma_height",
    "sigma_roll_deg": "sigma_roll", "sigma_pitch_deg": "sigma_pitch", "sigma_heading_deg": "sigma_azimuth",
}  # fmt: skip


class NovatelInsOptions(Strict):
    """Settings of `novatel_ins`."""

    message: Literal["INSPVAXA", "INSPVAA", "INSPVASA"] | None = None
    """Message that the poses come from, where a log holds several; the one that its beginning holds most often where
    left out, INSPVAXA before others of the same number, for it states σ."""


class NovatelIns(LogFormat):
    """A message a pose; anything else may stand between them.

    INSPVAX states position, velocity and attitude with their σ, its height above the geoid with the geoid's undulation,
    whose sum is the ellipsoidal height; INSPVA and INSPVAS state the ellipsoidal height and no σ. Roll turns about the
    forward axis, pitch about the right one, azimuth counts clockwise from true north, in degrees. The CRC-32 of each
    message is checked. Poses of an INS that still aligns are rejected; INS_HIGH_VARIANCE and INS_SOLUTION_FREE are
    poses. The datum is the receiver's or its corrections': state it as crs. GNSS positions in the same log (BESTPOS)
    are read with format = "novatel_bestpos".
    """

    name = "novatel_ins"
    title = "NovAtel SPAN log (ASCII): position, velocity and attitude of INSPVAX, INSPVA or INSPVAS"
    yields = ("trajectory",)
    time = "GPS week and seconds, in each message; of INSPVA and INSPVAS those of the pose, not of the header"
    options = NovatelInsOptions

    def sniff(self, path: Path) -> bool:
        """True if the beginning holds a sound message with a pose."""
        return any(name.startswith("INSPVA") for name in counted_messages(path))

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights, and choose the message."""
        source.need_file()
        counts = counted_messages(source.path)
        message = _message(source)
        gps_clock(source, "NovAtel's messages state")
        others = ", ".join(name for name in counts if name != message)
        attributes = {"world_frame": _placement(source).world, "read": message}
        return LogHeader(attributes | ({"not_read": others} if others else {}))

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream poses; a damaged message, and one without a solution, is rejected."""
        reader = PoseReader(source, gps_clock(source, "NovAtel's messages state"), _placement(source))
        for block in message_blocks(source.path, _message(source)):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            yield from reader.items(_poses(block, sieve), sieve)


def _message(source: LogSource) -> str:
    stated = options_of(source, NovatelInsOptions).message
    counts = counted_messages(source.path)
    found = [name for name in (*FIELDS, *FIELDS_OF_SHORT) if name.startswith("INSPVA") and counts[name]]
    if stated is None and not found:
        raise FormatError(
            "the beginning holds no sound INSPVAXA, INSPVAA or INSPVASA message",
            expected="one, with its right CRC-32",
            change="log INSPVAXA, or convert a binary log with NovAtel Convert",
            file=source.path,
        )
    return stated or max(found, key=lambda name: counts[name])


def _placement(source: LogSource) -> GeodeticPlacement:
    placement = GeodeticPlacement(source.need_crs(), "ellipsoidal", None, source.path)
    source.need_height("ellipsoidal", "the definition of NovAtel's messages")
    return placement


def _poses(block: TextBlock, sieve: Sieve) -> RawPoses:
    columns = block.columns
    status = np.array(block.text("status"))
    for word in np.unique(status[~np.isin(status, list(SOLVED))]):
        sieve.drop(status == word, f"no solution yet: {word[:40]}")
    roll, pitch, azimuth = (np.radians(block.number(name)) for name in ("roll", "pitch", "azimuth"))
    check_rph(roll, pitch, azimuth, sieve)
    with np.errstate(invalid="ignore", over="ignore"):  # of damaged records, dropped above or below
        attitude = ned_from_rph(roll, pitch, azimuth)
        position = np.stack([*(np.radians(block.number(name)) for name in ("longitude", "latitude")), height_m(block)])
    sigmas = {name: block.number(field) for name, field in _SIGMAS.items() if field in columns}
    velocity = np.stack([block.number("north"), block.number("east"), -block.number("up")])
    return RawPoses(block.records, block.offsets, epochs_ns(block, sieve), position, attitude, sigmas, velocity)


def height_m(block: TextBlock) -> npt.NDArray[np.float64]:
    """Return the ellipsoidal height (m, (n,)): as stated, or the height above the geoid and its undulation."""
    if "height" in block.columns:
        return block.number("height")
    return block.number("above_sea") + block.number("undulation")
