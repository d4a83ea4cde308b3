"""Settings of kinds that contradict one another are refused before any work."""

from __future__ import annotations

import pytest

from roadscan.assets.kinds.clearance import ClearanceOptions
from roadscan.assets.kinds.shoulder import ShoulderOptions
from roadscan.assets.kinds.sign import SignOptions
from roadscan.core.errors import ConfigError
from roadscan.core.strict import Strict


@pytest.mark.parametrize(
    ("options", "values", "words"),
    [
        (SignOptions, {"least_size_m": 3.0}, "least_size_m = 3 is more than greatest_size_m = 1.6"),
        (SignOptions, {"greatest_height_m": 1.2}, "least_height_m = 1.524 is more than greatest_height_m = 1.2"),
        (ClearanceOptions, {"lowest_m": 13.0}, "lowest_m = 13 is more than highest_m = 12"),
        (ShoulderOptions, {"greatest_width_m": 0.4}, "least_width_m = 0.5 is more than greatest_width_m = 0.4"),
    ],
)
def test_the_least_may_not_exceed_the_greatest(options: type[Strict], values: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        options.parse(values)
    assert options.parse({}) == options()
