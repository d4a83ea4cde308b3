"""OpenCRG grids read whole, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roadscan.core.errors import FormatError
from roadscan.formats.clouds.opencrg_file import CrgFile, CurvedRegularGrid


def read_crg(path: Path) -> CurvedRegularGrid:
    """Read an OpenCRG file.

    Raises
    ------
    FormatError
        if it is none, is of a kind that is not read, or is damaged (`OpenCrg` leaves
        out damaged rows in its place).
    """
    file = CrgFile.open(path)
    reference, heights = [np.empty((0, 3))], [np.empty((0, file.header.columns.size))]
    for block in file.blocks():
        if block.damaged.any():
            record = block.first_row + int(np.argmax(block.damaged.any(axis=1)))
            raise FormatError("a number cannot be read", expected="a finite number or a hole", file=path, record=record)
        reference.append(file.reference_of(block))
        heights.append(block.values[:, file.header.columns])
    if file.left_over():
        raise FormatError("the last row is cut off", expected="whole rows", file=path)
    grid = file.grid(np.concatenate(reference), np.concatenate(heights))
    if file.header.rows_claimed not in {None, grid.rows}:
        raise FormatError(f"there are {grid.rows:,} rows, the header claims {file.header.rows_claimed:,}", file=path)
    return grid
