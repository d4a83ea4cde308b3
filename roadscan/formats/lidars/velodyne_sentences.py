"""Checks the stamps of a Velodyne capture against its position packets: GPRMC sentences and the PPS byte."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from roadscan.core.witness import Finding, Witness
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.lidars.velodyne_hours import POSITION_BYTES, Fix
from roadscan.formats.lidars.velodyne_segments import LOCKED, SENTENCE_S, wrapped

_MINUTE_US: Final = 60_000_000  # microseconds of a minute
_EARLY_S: Final = -0.5  # least lead of a stamp over its sentence
_LATE_S: Final = 1.0
"""Greatest lead (s): a sentence names the second before it, and has just arrived at its stamp."""
_DRIFT_S: Final = 0.1
"""Scatter of sentences' arrivals (s), in the least of a minute."""
_LOCKED_SHARE: Final = 0.9
"""Least share of locked packets: a sensor that starts with the capture is not locked in its first seconds."""
_FEWEST: Final = 5
"""Least sentences of a minute for its minimum to count."""

PPS: Final = Witness(
    "lidar_pps",
    input="lidar",
    fault="The sensor is not locked to the pulse of its receiver, so that its stamps drift from GPS time.",
    asks="the PPS byte of the capture's position packets",
    does="stamps that agree with GPRMC are used; a capture whose PPS byte says otherwise than locked is named",
    told=("findings",),
)
SENTENCES: Final = Witness(
    "lidar_gprmc",
    input="lidar",
    fault="The sensor's seconds are not those of its receiver, or drift from them.",
    asks="GPRMC in the capture's position packets, against the stamps in the same packets",
    does="a log of stamps more than 5 s off is refused; whole seconds and a drift are named, and the stamps used",
    told=("error", "findings"),
)


@dataclass
class Sentences:
    """Counts the statements of a capture's position packets."""

    positions: int = 0
    locked: int = 0
    valid: int = 0
    contradicting: int = 0
    """Valid sentences more than 5 s off their stamp."""
    _minutes: dict[int, tuple[float, int]] = field(default_factory=dict)
    """Least lead of a stamp over its sentence (s), and how many sentences, by minute of the sentence."""

    def take(self, packet: Datagram) -> Fix | None:
        """Count a position packet; return its valid sentence."""
        if len(packet.payload) != POSITION_BYTES:
            return None
        self.positions += 1
        self.locked += packet.payload[202] == LOCKED
        fix = Fix.of(packet)
        if fix is None:
            return None
        self.valid += 1
        at_us = round(fix.unix_s * 1e6)
        ahead_s = wrapped(fix.stamp_us - at_us) / 1e6
        if abs(ahead_s) > SENTENCE_S:
            self.contradicting += 1
            return fix
        least, count = self._minutes.get(at_us // _MINUTE_US, (ahead_s, 0))
        self._minutes[at_us // _MINUTE_US] = min(least, ahead_s), count + 1
        return fix

    def findings(self) -> Iterator[Finding]:
        """Yield what is doubtful about the used stamps."""
        if self.locked < _LOCKED_SHARE * self.positions:
            yield PPS.finds(
                "",
                f"the PPS byte says locked in {self.locked:,} of {self.positions:,} position packets (firmware that "
                "writes no such byte leaves it 0); GPRMC puts the stamps within a second of GPS time at best, and they "
                "are used as they are",
            )
        if self.contradicting:
            yield SENTENCES.finds(
                "",
                f"{self.contradicting:,} of {self.valid:,} valid GPRMC sentences are more than {SENTENCE_S:g} s off "
                "the stamps, which go on evenly; the stamps are used",
            )
        yield from self._late()
        yield from self._drift()

    def _late(self) -> Iterator[Finding]:
        least = min((ahead for ahead, _ in self._minutes.values()), default=0.0)
        if not _EARLY_S <= least <= _LATE_S:
            yield SENTENCES.finds(
                "",
                f"the stamps are {least:+.1f} s off the GPRMC of their position packets throughout, where a sentence "
                "is less than a second old; all epochs may be wrong by whole seconds, and are used as they are",
            )

    def _drift(self) -> Iterator[Finding]:
        minutes = [(at, ahead) for at, (ahead, count) in sorted(self._minutes.items()) if count >= _FEWEST]
        if len(minutes) > 1 and abs(minutes[-1][1] - minutes[0][1]) > _DRIFT_S:
            yield SENTENCES.finds(
                "",
                f"the stamps drift by {minutes[-1][1] - minutes[0][1]:+.2f} s against GPRMC in "
                f"{minutes[-1][0] - minutes[0][0]} min; they are used as they are",
            )
