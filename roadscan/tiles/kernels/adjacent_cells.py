"""Runs of adjacent cells in a row, which loops can process many at a time."""

from __future__ import annotations

from roadscan.compute.kernel_options import bare


@bare
def run_end(column, row, start, end):
    """Return the end of the run that begins at `start`: cells of one row, each beside the one before.

    Parameters
    ----------
    column, row : (n,) uint16, sorted by row, column, no cell twice.
    start, end : int, the run ends at `end` at the latest.
    """
    step = 1
    while start + step < end and row[start + step] == row[start] and column[start + step] - column[start] == step:
        step *= 2
    low, high = start + (step >> 1), min(start + step, end)
    while high - low > 1:
        middle = (low + high) >> 1
        if row[middle] == row[start] and column[middle] - column[start] == middle - start:
            low = middle
        else:
            high = middle
    return low + 1
