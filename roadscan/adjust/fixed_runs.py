"""Runs that are fixed: their recorded poses are final, and other evidence estimates the errors of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roadscan.adjust.control.control_test import quantile
from roadscan.adjust.observations import COMPONENTS
from roadscan.adjust.unknowns import Unknowns
from roadscan.compute.array_types import Float64
from roadscan.core.gpstime import NS_PER_S


@dataclass(frozen=True)
class FixedRun:
    """A run that is fixed, and the corrections that it would have if it were not."""

    run: str
    error: Float64
    """(k, 6) at its knots, `COMPONENTS`."""
    sigma: Float64
    """(k, 6) 1 σ of its poses, as stated."""
    spans: Float64
    """(6,) number of correlation times in its drive, at least 1: the number of independent values."""

    def contradicted(self, false_alarm: float) -> list[tuple[str, float, float]]:
        """Component, largest error and its size in σ, of each error that right poses would exceed with that chance.

        An estimated error scatters by no more than the stated σ.
        """
        found = []
        for k, name in enumerate(COMPONENTS):
            there = self.sigma[:, k] > 0.0
            if not there.any():
                continue
            ratio = np.abs(self.error[there, k]) / self.sigma[there, k]
            worst = int(ratio.argmax())
            if ratio[worst] > quantile(false_alarm, int(np.ceil(len(COMPONENTS) * self.spans[k]))):
                found.append((name, float(self.error[there, k][worst]), float(ratio[worst])))
        return found


def fixed_runs(unknowns: Unknowns, error: Sequence[Float64]) -> tuple[FixedRun, ...]:
    """Returns the fixed runs of the adjustment; error : (k, 6) of each run, where no run is held."""
    found = []
    for number, (prior, knots) in enumerate(zip(unknowns.priors, unknowns.knots, strict=True)):
        if prior.fixed:
            spans = np.maximum((prior.last_gps_ns - prior.first_gps_ns) / NS_PER_S / prior.taus_s, 1.0)
            sigma = np.where(unknowns.active[number], prior.sigma_at(knots), 0.0)
            found.append(FixedRun(prior.run, error[number], sigma, spans))
    return tuple(found)
