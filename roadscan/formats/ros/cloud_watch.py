"""Watches what the clouds of a topic state against what their first messages let assume: times and intensities."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.gpstime import NS_PER_S
from roadscan.core.witness import Finding, Witness
from roadscan.formats.ros.point_times import UNKNOWN_NS
from roadscan.formats.ros.return_rows import INTENSITY_MAX

CLOUDS_OF_A_BAG: Final = Witness(
    "clouds_of_a_bag",
    input="clouds of a ROS bag",
    fault="The clock of the points' own times is not that of the headers, or intensities change their unit on the way.",
    asks="the middle of each sweep's own times against the header's stamp; each intensity against what the first "
    "messages hold",
    does="the points' own times are used; intensities are rounded and cut off at 65,535; both are named",
    told=("findings",),
)

_FAR_NS: Final = 300_000_000
"""Distance of a sweep's middle from its header (ns) that is named: drivers stamp the beginning or the end of a sweep,
which lasts a tenth of a second, or the moment of publication soon after."""
_STEP_NS: Final = 50_000_000  # change of that distance from one message to the next that is named (ns)


class CloudWatch:
    """Counts over the messages of a topic."""

    def __init__(self) -> None:
        self._middle_ns: list[int] = []
        self._rounded = 0
        self._bright = 0

    def times(self, offsets_ns: npt.NDArray[np.int64]) -> None:
        """Take the times (n,) of a message's points after its stamp, which count from the origin of the clock."""
        if offsets_ns.size and offsets_ns.max() == UNKNOWN_NS:
            offsets_ns = offsets_ns[offsets_ns != UNKNOWN_NS]
        if offsets_ns.size:
            self._middle_ns.append((int(offsets_ns.min()) + int(offsets_ns.max())) // 2)

    def intensity(self, values: npt.NDArray[np.generic]) -> None:
        """Take the intensities (n,) of a message, which are stored as whole numbers up to 65,535."""
        numbers: Any = values
        if numbers.dtype.kind == "f" and (odd := numbers[numbers != np.rint(numbers)]).size:
            self._rounded += int(np.count_nonzero(~np.isnan(odd)))
        if numbers.dtype.itemsize > 2:
            self._bright += int(np.count_nonzero(numbers > INTENSITY_MAX))

    def findings(self) -> Iterator[Finding]:
        """Yield what is doubtful, at the end of the topic."""
        if self._middle_ns:
            middle = np.array(self._middle_ns)
            usual = int(np.median(middle))
            steps = np.abs(np.diff(middle))
            if abs(usual) > _FAR_NS:
                yield CLOUDS_OF_A_BAG.finds(
                    "",
                    f"the points' own times lie {usual / NS_PER_S:+.3f} s from the headers' stamps (middle of a sweep, "
                    "median of the messages): one of the two clocks is off; the points' own times are used",
                )
            if steps.size and steps.max() > _STEP_NS:
                yield CLOUDS_OF_A_BAG.finds(
                    "",
                    f"the points' own times step {np.count_nonzero(steps > _STEP_NS)} times against the headers' "
                    f"stamps, by {steps.max() / NS_PER_S:.3f} s at the most; the points' own times are used",
                )
        if self._rounded:
            yield CLOUDS_OF_A_BAG.finds(
                "",
                f"{self._rounded:,} intensities are fractions, where the first messages hold whole numbers: they are "
                "rounded; options.intensity_full says which value is the brightest",
                self._rounded,
            )
        if self._bright:
            yield CLOUDS_OF_A_BAG.finds(
                "",
                f"{self._bright:,} intensities are brighter than {INTENSITY_MAX:,} and are cut off; "
                "options.intensity_full says which value is the brightest",
                self._bright,
            )
