"""Interpolates positions linearly between ticks, the multiples of a time step at which they are known."""

from __future__ import annotations

from roadscan.compute.kernel_options import kernel


@kernel
def between_ticks(epochs, step, first, number, at, out):
    """Interpolate positions at epochs.

    Parameters
    ----------
    epochs : (n,) int64, ns; step : int64, ns from tick to tick; first : int64, epoch of tick 0 divided by the step.
    number : (t,) int64, row in `at` of each tick from the first on; the next tick's row follows a needed one's.
    at : (k, 3) float64, places at ticks; NaN where there is none.
    out : (3, n) float64, out.
    """
    i, length = 0, float(step)
    while i < epochs.size:  # epochs ascend, so many of them share a tick
        tick = epochs[i] // step
        begin, row, last = tick * step, number[tick - first], i + 1
        while last < epochs.size and begin <= epochs[last] < begin + step:
            last += 1
        for axis in range(3):
            before, after = at[row, axis], at[row + 1, axis]
            for k in range(i, last):
                share = (epochs[k] - begin) / length
                out[axis, k] = before * (1.0 - share) + after * share
        i = last
