"""Compares the stamps of messages' headers with the stamps at which the recording computer received them.

A message is never received before it was measured, and the fastest of some seconds took much the same time as those of
any other seconds. So the least difference of each window shows how the two clocks run against each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from roadscan.core.gpstime import NS_PER_S, SCALES, Clock, TimeSystem, ahead_of_utc_s
from roadscan.core.witness import Finding, Witness

STAMPS_OF_A_BAG: Final = Witness(
    "stamps_of_a_bag",
    input="topics of a ROS bag",
    fault="The clock that stamped the headers steps, drifts or counts on another scale than is stated.",
    asks="the stamps at which the recording computer received the messages: the least latency of each 10 s",
    does="all messages are used by the stamps that are stated; the finding names the offset, step or drift",
    told=("findings",),
)

_WINDOW_NS: Final = 10 * NS_PER_S  # the least latency is found in windows of so long
_STEP_NS: Final = 50_000_000
"""A change of the least latency between two windows that is named a step (ns): networks and queues seldom cost more for
10 s, and at 20 m/s it is 1 m."""
_DRIFT_NS: Final = 20_000_000
"""Change of the least latency over the log that is named a drift (ns), where no step explains it."""
_EARLY_NS: Final = 2_000_000
"""A message that was received so long before its stamp (ns) is named: clocks of NTP agree better."""
_LATE_NS: Final = 2 * NS_PER_S  # a least latency of so much (ns) is named
_SAME_SCALE_NS: Final = NS_PER_S // 2  # an offset so near to one of two scales is taken for it (ns)
_OWN_COUNT_NS: Final = 86_400 * NS_PER_S  # stamps farther apart count from another origin, such as power-on


class Arrivals:
    """The least difference of receive stamp and header stamp of each window of a topic."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._least: dict[int, int] = {}
        """Receive less header stamp (ns), by the window of the receive stamp."""

    def take(self, header_ns: int, receive_ns: int) -> None:
        """Take the stamps of a message (ns)."""
        window, late = receive_ns // _WINDOW_NS, receive_ns - header_ns
        if late < self._least.get(window, late + 1):
            self._least[window] = late

    def findings(self, *, by_header: bool) -> Iterator[Finding]:
        """Yield what is doubtful, at the end of the topic; `by_header` where the headers' stamps are used."""
        if not self._least:
            return
        windows = np.array(sorted(self._least))
        late = np.array([self._least[window] for window in windows.tolist()])
        used = "the headers' stamps are used" if by_header else "the receive stamps are used"
        offset = self._offset(int(np.median(late)), int(windows[0]) * 10)
        if offset:
            yield STAMPS_OF_A_BAG.finds("", f"{offset}; {used}")
        steps = np.diff(late)
        worst = int(np.argmax(np.abs(steps))) if steps.size else 0
        if steps.size and abs(steps[worst]) > _STEP_NS:
            yield STAMPS_OF_A_BAG.finds(
                "",
                f"the difference of receive stamp and header stamp steps {np.count_nonzero(np.abs(steps) > _STEP_NS)} "
                f"times, by {steps[worst] / NS_PER_S:+.3f} s at the most ({(windows[worst + 1] - windows[0]) * 10} s "
                f"after the first message): one of the two clocks was set, or messages waited; {used}",
            )
        elif abs(grown := int(late[-1] - late[0])) > _DRIFT_NS:
            seconds = float(windows[-1] - windows[0]) * 10
            yield STAMPS_OF_A_BAG.finds(
                "",
                f"the difference of receive stamp and header stamp grows by {grown / NS_PER_S:+.3f} s in "
                f"{seconds:,.0f} s ({grown / 1e3 / seconds:+.1f} ppm): the two clocks drift apart; {used}",
            )

    def _offset(self, late_ns: int, unix_s: int) -> str:
        """Say what a constant difference means; '' where it is the way of a message."""
        if abs(late_ns) > _OWN_COUNT_NS or self._clock.system is TimeSystem.FREE:
            return ""  # a counter of its own, which the stated clock explains
        for system, ahead_s in ahead_of_utc_s(unix_s).items():
            if abs(late_ns + ahead_s * NS_PER_S) < _SAME_SCALE_NS:
                if self._clock.system is system:
                    return ""
                return (
                    f"the headers' stamps are {ahead_s} s ahead of the receive stamps, as {SCALES[system]} is ahead of "
                    f"UTC, and the log's clock says {self._clock.system}: headers on that scale need clock.system = "
                    f"{system}"
                )
        if late_ns < -_EARLY_NS:
            return f"messages were received {-late_ns / NS_PER_S:.3f} s before their headers' stamps: the clocks differ"
        if late_ns > _LATE_NS:
            return f"messages were received {late_ns / NS_PER_S:.3f} s or more after the stamps of their headers"
        return ""
