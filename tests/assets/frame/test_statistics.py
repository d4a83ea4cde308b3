"""Statistics of a survey from its samples."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.scene import Statistics, together


def test_samples_together_tell_the_quantile_of_all_their_values() -> None:
    random = np.random.default_rng(4)
    parts = [random.gamma(2.0, scale, size) for scale, size in ((0.01, 4000), (0.03, 300), (0.02, 9000))]
    samples = []
    for part in parts:
        own = Statistics()
        assert own.of("noise_m", 0.25, lambda part=part: part) == np.quantile(part, 0.25)
        samples.append(own.measured)
    ((name, (value, count)),) = together(samples).items()
    assert (name, count) == ("noise_m", 3)
    assert value == pytest.approx(np.quantile(np.concatenate(parts), 0.25), rel=0.02)
    assert together(samples[::-1]) == together(samples)


def test_what_the_survey_gives_is_not_measured() -> None:
    known = Statistics({"noise_m": 0.004})
    assert known.of("noise_m", 0.5, lambda: pytest.fail("measured")) == 0.004
    assert known.of("light", 0.5, lambda: np.zeros(0)) is None
    assert known.measured == {}
