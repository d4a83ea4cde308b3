"""Divides a Velodyne capture at steps of the sensor's clock, and finds which parts are on GPS time.

The stamps of a sensor that starts anew, or finds its PPS late, step. Three witnesses in the capture show it: the
recording computer's clock, the GPRMC sentence in the position packets with its PPS byte, and the rate of the packets,
which go on evenly where it was the computer's clock that was set.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Int64
from roadscan.core.witness import Finding, Witness
from roadscan.formats.lidars.pcap import Datagram
from roadscan.formats.lidars.velodyne_hours import HOUR_S, HOUR_US, POSITION_BYTES, Fix, iso, leaps, unroll

STEP_US: Final = 250_000
"""Largest delay (µs) with which a busy recording computer stamps packets."""
_AHEAD_US: Final = 100_000
"""A stamp this far (µs) ahead of the computer's clock has stepped: no packet is captured before it is sent."""
_EVEN_US: Final = 20_000
"""Packets within this interval (µs), or within four usual ones, are of one clock."""
_RECENT_CHUNKS: Final = 16
"""Chunks of 640 packets whose least delay counts (some 10 s: no computer buffers longer)."""
_LEAP_SECOND_US: Final = 1_000_000  # a leap second
_SET_US: Final = 2_000_000
"""Longest delay (µs) of a busy computer; a larger jump means that its clock was set."""

SENTENCE_S: Final = 5.0
"""A stamp farther from its GPRMC contradicts it (s)."""
_SENTENCE_SCATTER_S: Final = 1.2
"""Scatter of sentences (s): one names a second that is up to a second old, and takes 0.2 s to arrive."""
_NEAR_S: Final = 2.0
"""Largest error of a recording computer that keeps UTC (s)."""
LOCKED: Final = 2
"""PPS byte of a locked sensor (0: no PPS; 1: trying; 3: error): VLP-16 manual 63-9243, chapter 9."""

STEPPED: Final = Witness(
    "lidar_clock_step",
    input="lidar",
    fault="The sensor's clock steps inside a capture: it starts anew, or its PPS is found late or lost.",
    asks="the capture's own clock, GPRMC and the PPS byte of the position packets, and the even rate of the packets",
    does="packets of a part that cannot be put on GPS time are left out; a log of which no part or only a later part "
    "can is refused; a step of the capture's own clock is named, and the stamps are used",
    told=("error", "rejects", "findings"),
)

_CONTRADICTS: Final = "the sensor's clock stepped, and its stamps contradict GPRMC"
_NOT_LOCKED: Final = "the sensor's clock stepped, and it is not locked to PPS"
_UNKNOWN: Final = "the sensor's clock stepped, and nothing in the capture puts its stamps on GPS time"
_AGAIN: Final = "the capture goes back to a time that it holds already"


def wrapped(us: int, period: int = HOUR_US) -> int:
    """Return the difference of two stamps past the hour, within half an hour either way (µs)."""
    return (us + period // 2) % period - period // 2


class Step(NamedTuple):
    """A data packet at which the stamps step."""

    packet: int
    """Index in its chunk."""
    ahead_us: int
    """Lead that the stamps gain over the capture's clock (µs); 0 where both go back."""


@dataclass
class StepWatch:
    """Finds the data packets at which the stamps step, chunk by chunk."""

    set_us: list[int] = field(default_factory=list)
    """Forward corrections (µs) of the capture's clock while packets continued evenly."""
    _last: tuple[int, int] | None = None
    """Stamp and capture time (µs) of the last packet."""
    _delay_us: int = 0
    """Delay of the capture behind the stamps, relative to that of the first packet (µs)."""
    _least_us: deque[int] = field(default_factory=lambda: deque(maxlen=_RECENT_CHUNKS))
    """Least delay in each of the last chunks (µs)."""
    _ends: list[tuple[int, int]] = field(default_factory=list)
    """Unrolled stamp (µs) and least delay (µs) of the first chunk and of the last."""
    _passed_us: int = 0

    def steps(self, stamps_us: Int64, capture_us: Int64) -> list[Step]:
        """Return the steps among sound packets (n,), n > 0, in the capture's order."""
        before = [] if self._last is None else [self._last]
        stamps = np.concatenate([np.array([b[0] for b in before], dtype=np.int64), stamps_us])
        captured = np.concatenate([np.array([b[1] for b in before], dtype=np.int64), capture_us])
        self._last = int(stamps[-1]), int(captured[-1])
        waited = np.diff(captured)
        passed = _wrapped(np.diff(stamps))
        ahead = _wrapped(passed - waited)
        odd = np.flatnonzero((np.abs(ahead) > _AHEAD_US) | (waited < -_AHEAD_US))
        even_us = max(_EVEN_US, 4 * int(np.median(passed))) if odd.size else 0
        delays = self._delay_us - np.cumsum(ahead)
        found: list[Step] = []
        start = 0
        for k in odd.tolist():
            self._note(delays[start:k])
            start, by_us = k, int(ahead[k])
            if stamps[k] >= HOUR_US and abs(by_us + _LEAP_SECOND_US) <= STEP_US:
                delays[k:] += by_us  # the hour had 3,601 s
            elif 0 < passed[k] <= even_us:  # the packets continue evenly: the capture's clock stepped
                if abs(by_us) > _SET_US:
                    self.set_us.append(int(waited[k] - passed[k]))
                    delays[k:] += by_us
            elif self._is_step(by_us, int(passed[k]), int(delays[k])):
                found.append(Step(k + 1 - len(before), by_us))
                delays[k:] += by_us
        self._note(delays[start:])
        self._passed_us += int(passed.sum())
        if delays.size:
            self._delay_us = int(delays[-1])
            self._ends[1:] = [(self._passed_us, int(delays.min()))]
        return found

    @property
    def drift(self) -> tuple[float, float]:
        """Return the gain of the capture's clock over the stamps, first chunk to last (s), and its rate (1)."""
        if len(self._ends) < 2:
            return 0.0, 0.0
        (from_us, first_us), (to_us, last_us) = self._ends
        return (last_us - first_us) / 1e6, (last_us - first_us) / max(1, to_us - from_us)

    def _is_step(self, ahead_us: int, passed_us: int, delay_us: int) -> bool:
        """Return False where the capture was late, or has caught up."""
        if abs(ahead_us) <= _AHEAD_US:
            return True  # both go back
        if ahead_us < 0:
            return ahead_us < -STEP_US or passed_us < -_AHEAD_US
        return delay_us < min(self._least_us, default=delay_us + ahead_us) - _AHEAD_US

    def _note(self, delays_us: Int64) -> None:
        if delays_us.size:
            self._least_us.append(int(delays_us.min()))


def _wrapped(us: Int64) -> Int64:
    """Return differences (n,) of stamps past the hour, within half an hour either way (µs)."""
    return us - np.rint(us / HOUR_US).astype(np.int64) * HOUR_US


@dataclass
class Part:
    """A part of a capture without a step of the sensor's clock."""

    first: int
    """Record number of its first data packet."""
    stamp_us: int
    """Stamp of that packet."""
    capture_us: int
    """Its capture time (POSIX, µs)."""
    ahead_us: int
    """Lead of its stamps over those of the capture's first part, by the capture's clock (µs)."""
    packets: int = 0
    ends_us: int = 0
    """Capture time of the last packet."""
    fix: Fix | None = None
    """First valid sentence that agrees with the stamps, or else the first valid one."""
    fix_hours: int = 0
    """Hours from the hour of the first packet to that of the fix."""
    sentence_s: float | None = None
    """Lead of the stamps over GPRMC (s): the value nearest to zero."""
    positions: int = 0
    locked: int = 0
    """Number of position packets, and of those whose PPS byte says locked."""

    @property
    def confirmed(self) -> bool:
        """True where a sentence in it agrees with its stamps."""
        return self.sentence_s is not None and abs(self.sentence_s) <= SENTENCE_S

    @property
    def hour_unix_s(self) -> int | None:
        """Start of the hour of its first packet (POSIX s), by a sentence that agrees; None without one."""
        return self.fix.hour_unix_s() - HOUR_S * self.fix_hours if self.confirmed and self.fix is not None else None

    @property
    def is_locked(self) -> bool:
        """True where more than half of the position packets say that the sensor is locked to PPS."""
        return 2 * self.locked > self.positions

    @property
    def near(self) -> bool:
        """True where its stamps agree with the capture's clock, apart from whole hours."""
        return abs(wrapped(self.capture_us - self.stamp_us)) <= _NEAR_S * 1e6

    def misses_us(self, position: Datagram) -> int:
        """Return how far the stamp of a position packet is off this part's (µs), by the capture's clock."""
        stamp_us = int.from_bytes(position.payload[198:202], "little")
        return abs(wrapped(stamp_us - self.stamp_us - (position.capture_ns // 1000 - self.capture_us)))

    def take(self, packet: Datagram, unrolled_us: int, sent_us: int) -> None:
        """Update from a position packet.

        Parameters
        ----------
        unrolled_us, sent_us : stamp of a neighbouring data packet, counted on over hours from the part's first, and
            as it was sent.
        """
        self.positions += 1
        self.locked += packet.payload[202] == LOCKED
        fix = Fix.of(packet)
        if fix is None:
            return
        ahead_s = wrapped(fix.stamp_us - round(fix.unix_s * 1e6)) / 1e6
        if self.sentence_s is None or abs(ahead_s) < abs(self.sentence_s):
            if self.fix is None or not self.confirmed:
                self.fix = fix
                at_us = unrolled_us + wrapped(fix.stamp_us - sent_us)
                self.fix_hours = (at_us - fix.stamp_us + HOUR_US // 2) // HOUR_US
            self.sentence_s = ahead_s


@dataclass
class Parts:
    """Divides a capture into parts, packet by packet."""

    found: list[Part] = field(default_factory=list)
    seen: int = 0
    """Number of data packets added."""
    _watch: StepWatch = field(default_factory=StepWatch)
    _data: list[tuple[int, int, int]] = field(default_factory=list)
    """Record number, stamp and capture time (µs) of pending data packets."""
    _positions: list[tuple[int, Datagram]] = field(default_factory=list)
    """Pending position packets, each with the number of pending data packets before it."""
    _previous_us: int | None = None
    """Last stamp, unrolled over hours from the part's first."""
    _before: tuple[Part, int, int, int] | None = None
    """Last data packet: part, unrolled stamp, stamp, capture time."""

    def data(self, number: int, stamp_us: int, capture_us: int) -> None:
        """Add a data packet."""
        self._data.append((number, stamp_us, capture_us))
        self.seen += 1

    def position(self, packet: Datagram) -> None:
        """Add a position packet."""
        if len(packet.payload) == POSITION_BYTES:
            self._positions.append((len(self._data), packet))

    def flush(self, last: bool = False) -> None:
        """Judge the pending packets; position packets after the last data packet stay pending, unless `last`."""
        known = [] if self._before is None else [self._before]
        if self._data:
            known += self._divided(np.array(self._data, dtype=np.int64))
        shift = 0 if self._before is None else 1
        waiting: list[tuple[int, Datagram]] = []
        for at, packet in self._positions:
            near = known[max(0, at + shift - 1) : at + shift + 1]
            if not near or (at >= len(known) - shift and not last):
                waiting.append((0, packet))
                continue
            stamp_us = int.from_bytes(packet.payload[198:202], "little")
            sent_us = packet.capture_ns // 1000
            part, unrolled_us, own_us, _ = min(
                near, key=lambda one: abs(wrapped(stamp_us - one[2] - (sent_us - one[3])))
            )
            part.take(packet, unrolled_us, own_us)
        self._positions, self._data = waiting, []
        if known:
            self._before = known[-1]

    def _divided(self, data: Int64) -> list[tuple[Part, int, int, int]]:
        """Return part, unrolled stamp, stamp and capture time of each data packet; damaged ones take those before."""
        stamps, captured = data[:, 1], data[:, 2]
        sound = ~leaps(stamps, self._previous_us)
        rows = np.flatnonzero(sound)
        steps = self._watch.steps(stamps[rows], captured[rows])
        ahead = {int(rows[s.packet]): s.ahead_us for s in steps}
        starts = sorted({0, *ahead})
        out: list[tuple[Part, int, int, int]] = []
        for start, end in zip(starts, [*starts[1:], len(data)], strict=True):
            own = rows[(rows >= start) & (rows < end)]
            if own.size and (start in ahead or not self.found):
                total_us = (self.found[-1].ahead_us if self.found else 0) + ahead.get(start, 0)
                number, stamp_us, capture_us = (int(v) for v in data[own[0]])
                self.found.append(Part(number, stamp_us, capture_us, wrapped(total_us)))
                self._previous_us = None
            if not own.size:
                continue
            part = self.found[-1]
            unrolled = unroll(stamps[own], self._previous_us)
            self._previous_us = int(unrolled[-1])
            part.packets += own.size
            part.ends_us = int(captured[own[-1]])
            places = np.clip(np.searchsorted(own, np.arange(start, end), side="right") - 1, 0, None)
            out += [(part, int(unrolled[k]), int(stamps[own[k]]), int(captured[own[k]])) for k in places]
        return out


@dataclass(frozen=True)
class Verdict:
    """Verdict whether a part of a capture is on GPS time."""

    part: Part
    ahead_us: int
    """Lead of its stamps over those of the reference, by the capture's clock (µs)."""
    base: Part
    """The reference."""
    reason: str
    """Reason why it is left out; "" for a part that is used."""

    @property
    def kept(self) -> bool:
        """True for a part that is used."""
        return not self.reason

    @property
    def start_us(self) -> int:
        """Expected first stamp, counted from the hour of the reference's first packet (µs)."""
        heard, since = self.part.hour_unix_s, self.base.hour_unix_s
        if heard is not None and since is not None:
            return self.part.stamp_us + (heard - since) * 1_000_000
        return self.base.stamp_us + self.part.capture_us - self.base.capture_us + self.ahead_us

    def findings(self, left_out: int) -> list[Finding]:
        """Return findings on the part; none for the reference, and for a part that continues it.

        Parameters
        ----------
        left_out : how many data packets of it were left out.
        """
        place = f"from record {self.part.first:,} on ({iso(self.part.capture_us / 1e6)} by the capture's clock)"
        if self.part is self.base or (self.kept and abs(self.ahead_us) <= STEP_US):
            return []
        if self.reason == _AGAIN:
            text = f"{place} the capture goes back to a time that it holds already"
        else:
            text = f"{place} the stamps are {self.ahead_us / 1e6:+.3f} s off those of the rest, by the capture's clock"
            text += self._heard()
        if self.kept:
            return [STEPPED.finds("", f"{text}: one of the two clocks was set there, and the stamps are used")]
        return [STEPPED.finds("", f"{text}: its {left_out:,} data packets were left out", left_out)]

    def _heard(self) -> str:
        """Return in words what GPRMC and PPS say about the part."""
        out = "" if self.part.sentence_s is None else f"; they are {self.part.sentence_s:+.1f} s off GPRMC"
        if self.part.positions:
            out += f"; PPS is locked in {self.part.locked:,} of its {self.part.positions:,} position packets"
        return out


def reference(parts: Sequence[Part], sentences: bool = True) -> Part:
    """Return the part that defines the capture's clock: confirmed by GPRMC and PPS, or else by the capture's clock.

    Parameters
    ----------
    sentences : False for a sensor without GPS, whose stamps count from no hour.
    """
    if not sentences:
        return parts[0]
    confirmed = [p for p in parts if p.confirmed]
    if confirmed:
        return max(confirmed, key=lambda p: (p.is_locked, p.packets))
    heard = [p for p in parts if p.fix is not None]
    if heard:
        return heard[0]
    near = [p for p in parts if p.near]
    return parts[0] if parts[0].near or not near else max(near, key=lambda p: p.packets)


def judged(parts: Sequence[Part], sentences: bool = True) -> list[Verdict]:
    """Return a verdict for each part, in the capture's order (`sentences` as for :func:`reference`)."""
    base = reference(parts, sentences)
    kept = [base]
    verdicts: list[Verdict] = []
    for part in parts:
        ahead_us = wrapped(part.ahead_us - base.ahead_us)
        reason = "" if part is base else _fault(part, base, ahead_us, sentences)
        if not reason and part is not base:
            again = any(part.capture_us <= one.ends_us and one.capture_us <= part.ends_us for one in kept)
            reason = _AGAIN if again and abs(ahead_us) <= STEP_US else ""
            kept += [] if reason else [part]
        verdicts.append(Verdict(part, ahead_us, base, reason))
    return verdicts


def _fault(part: Part, base: Part, ahead_us: int, sentences: bool) -> str:
    """Return why a part is not on GPS time; "" where it is."""
    if sentences and part.sentence_s is not None and not part.confirmed:
        return _CONTRADICTS
    if abs(ahead_us) <= STEP_US:
        return ""
    if not sentences or part.sentence_s is None or base.sentence_s is None:
        return _UNKNOWN
    if part.is_locked:
        return ""
    agree = abs(part.sentence_s - base.sentence_s) <= _SENTENCE_SCATTER_S
    return "" if agree and abs(ahead_us) > 2 * _SENTENCE_SCATTER_S * 1e6 else _NOT_LOCKED


def hours_later(first: Part, later: Part) -> int:
    """Return the hours from a capture's first packet to a later part, by the capture's clock."""
    past_us = first.capture_us % HOUR_US if later.near else first.stamp_us
    return round((past_us + later.capture_us - first.capture_us - later.stamp_us) / (HOUR_S * 1_000_000))


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
