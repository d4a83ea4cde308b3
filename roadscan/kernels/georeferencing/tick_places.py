"""Places between ticks: of many epochs, linear between places that are known at multiples of a step of time."""

from __future__ import annotations

from roadscan.kernels.options import kernel


@kernel
def between_ticks(epochs, step, first, number, at, out):
    """Interpolate places.

    Parameters
    ----------
    epochs : (n,) int64, ns; step : int64, ns from tick to tick; first : int64, epoch of tick 0 divided by the step.
    number : (t,) int64, row in `at` of each tick from the first on; the next tick's row follows a needed one's.
    at : (k, 3) float64, places at ticks; NaN where there is none.
    out : (n, 3) float64, out.
    """
    begin, row = first * step, number[0]
    for i in range(epochs.size):
        past = epochs[i] - begin
        if past < 0 or past >= step:  # epochs follow one another, so that a tick holds many of them
            tick = epochs[i] // step
            begin, row = tick * step, number[tick - first]
            past = epochs[i] - begin
        share = past / step
        for axis in range(3):
            out[i, axis] = at[row, axis] * (1.0 - share) + at[row + 1, axis] * share
