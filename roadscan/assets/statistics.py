"""Statistics of a survey that the search of all its squares shares: noise, density and brightness."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.quantiles import weighted_quantile

Values = npt.NDArray[np.floating[Any]]

_NODES: Final = 65
"""A sample stores its values as so many quantiles, from which those of all samples follow to about a hundredth."""


class Measured(NamedTuple):
    """Values of a statistic in one scene."""

    share: float
    """The statistic is the quantile of this share."""
    quantiles: tuple[float, ...]
    """Quantiles of the values at even shares."""
    number: int


class Statistics:
    """Statistics by name. One that the survey does not give is measured in the scene that asks for it.

    A scene's own noise or brightness would make its results depend on how squares are cut: so samples of the survey are
    measured, and every square is searched by what all of them tell together.
    """

    def __init__(self, known: Mapping[str, float] | None = None) -> None:
        self._known: dict[str, float] = dict(known or {})
        self.measured: dict[str, Measured] = {}
        """What scenes measured since."""
        self._own: dict[str, float] = {}

    def known(self, name: str) -> float | None:
        """Returns a statistic of the survey; None where it gives none."""
        return self._known.get(name)

    def of(self, name: str, share: float, values: Callable[[], Values]) -> float | None:
        """Returns a statistic: a quantile of values (n,), which are asked for where the survey does not give it."""
        if name in self._known:
            return self._known[name]
        if name not in self._own:
            found = values()
            if not found.size:
                return None
            nodes = np.quantile(found, np.linspace(0.0, 1.0, _NODES)).tolist()
            self.measured[name] = Measured(share, tuple(nodes), int(found.size))
            self._own[name] = float(np.quantile(found, share))
        return self._own[name]


def together(measured: Iterable[Mapping[str, Measured]]) -> dict[str, tuple[float, int]]:
    """Returns each statistic over all values of the samples, and how many samples tell it."""
    found: dict[str, list[Measured]] = {}
    for one in measured:
        for name, value in one.items():
            found.setdefault(name, []).append(value)
    return {name: (_quantile(some), len(some)) for name, some in sorted(found.items())}


def _quantile(some: list[Measured]) -> float:
    values = np.concatenate([one.quantiles for one in some])
    weights = np.repeat([one.number for one in some], _NODES)
    return weighted_quantile(values, weights, some[0].share)
