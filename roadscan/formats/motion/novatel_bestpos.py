"""Positions that NovAtel's receivers write as ASCII: BESTPOS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import FormatError
from roadscan.formats.motion.novatel_messages import counted_messages, epochs_ns, message_blocks
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES, UNKNOWN_QUALITY, GnssReader, RawSolutions, gps_clock
from roadscan.ingest.reading.poses import GeodeticPlacement
from roadscan.ingest.reading.records import EpochReader, Sieve
from roadscan.ingest.reading.text_table import TextBlock

_QUALITIES: Final = {
    "NONE": "none", "FIXEDPOS": "manual", "FIXEDHEIGHT": "manual", "SINGLE": "single", "PSRDIFF": "dgps",
    "WAAS": "sbas", "PROPAGATED": "dead_reckoning", "OMNISTAR": "dgps", "CDGPS": "dgps", "L1_FLOAT": "float",
    "IONOFREE_FLOAT": "float", "NARROW_FLOAT": "float", "L1_INT": "fixed", "WIDE_INT": "fixed", "NARROW_INT": "fixed",
    "RTK_DIRECT_INS": "fixed", "INS_SBAS": "sbas", "INS_PSRSP": "single", "INS_PSRDIFF": "dgps",
    "INS_RTKFLOAT": "float", "INS_RTKFIXED": "fixed", "PPP_CONVERGING": "ppp", "PPP": "ppp", "OPERATIONAL": "single",
    "WARNING": "single", "OUT_OF_BOUNDS": "none", "INS_PPP_CONVERGING": "ppp", "INS_PPP": "ppp",
    "PPP_BASIC_CONVERGING": "ppp", "PPP_BASIC": "ppp", "INS_PPP_BASIC_CONVERGING": "ppp", "INS_PPP_BASIC": "ppp",
}  # fmt: skip
"""Quality by position type (NovAtel, OEM7 documentation, "Position or Velocity Type")."""


class NovatelBestpos(LogFormat):
    """A BESTPOS message a position; anything else may stand between them.

    Latitude, longitude, height above the geoid and the geoid's undulation, whose sum is the ellipsoidal height, σ, age
    of corrections and satellites. The CRC-32 of each message is checked. A message without a computed solution has
    quality 'none'. The datum is the receiver's or its corrections': state it as crs.
    """

    name = "novatel_bestpos"
    title = "NovAtel log (ASCII): positions of BESTPOS"
    yields = ("gnss",)
    time = "GPS week and seconds, in each message"

    def sniff(self, path: Path) -> bool:
        """True if the beginning holds a sound BESTPOS, and no pose of an INS."""
        counts = counted_messages(path)
        return counts["BESTPOSA"] > 0 and not any(name.startswith("INSPVA") for name in counts)

    def header(self, source: LogSource) -> LogHeader:
        """Check clock, CRS and heights."""
        source.need_file()
        gps_clock(source, "NovAtel's messages state")
        if not counted_messages(source.path)["BESTPOSA"]:
            raise FormatError("the beginning holds no sound BESTPOSA message", expected="one", file=source.path)
        return LogHeader({"world_frame": _placement(source).world, "read": "BESTPOSA"})

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Stream positions; a damaged message is rejected."""
        reader = GnssReader(source, _placement(source))
        epochs = EpochReader(gps_clock(source, "NovAtel's messages state"), source.path)
        for block in message_blocks(source.path, "BESTPOSA"):
            if isinstance(block, Reject):
                yield block
                continue
            sieve = Sieve(block.records.size)
            stamps = epochs.epochs(epochs_ns(block, sieve), sieve, block.records)
            yield from reader.items(_solutions(block, stamps, sieve), sieve)


def _placement(source: LogSource) -> GeodeticPlacement:
    placement = GeodeticPlacement(source.need_crs(), "ellipsoidal", None, source.path)
    source.need_height("ellipsoidal", "BESTPOS, whose height and undulation are added")
    return placement


def _solutions(block: TextBlock, epochs: npt.NDArray[np.int64], sieve: Sieve) -> RawSolutions:
    codes = {word: QUALITIES.index(name) for word, name in _QUALITIES.items()}
    solved = [word == "SOL_COMPUTED" for word in block.text("status")]
    quality = np.where(solved, [codes.get(word, UNKNOWN_QUALITY) for word in block.text("type")], 0).astype(np.int64)
    sieve.drop(quality == UNKNOWN_QUALITY, "the type of the position is unknown")
    quality[quality == UNKNOWN_QUALITY] = NO_POSITION
    with np.errstate(over="ignore"):  # of damaged records, which their limits drop
        height = block.number("above_sea") + block.number("undulation")
    position = np.stack([*(np.radians(block.number(name)) for name in ("longitude", "latitude")), height])
    columns = {
        "satellites": block.number("used"),
        "sigma_north_m": block.number("sigma_latitude"),
        "sigma_east_m": block.number("sigma_longitude"),
        "sigma_down_m": block.number("sigma_height"),
        "age_s": block.number("differential_age"),
    }
    return RawSolutions(block.records, block.offsets, epochs, position, quality, columns)
