"""Arms of few returns."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.assets.upright.standing import _reach


@pytest.mark.parametrize("count", [10, 12])
def test_the_end_of_an_arm_has_a_height_where_its_last_return_lies_apart(count: int) -> None:
    """The 98 % quantile lies in the gap before it: no return is 0.4 m before that place to 0.1 m beyond it."""
    along = np.append(np.linspace(0.1, 1.15, count - 1), 1.74)
    reach_m, height_m = _reach(along, np.where(along == 1.74, 5.2, 5.0))
    assert 1.55 < reach_m < 1.64
    assert height_m == 5.2
