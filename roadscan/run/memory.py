"""Estimates a worker's memory from the readings of its block."""

from __future__ import annotations

from typing import Final

BYTES_PER_READING: Final = 100
"""Measured memory of a worker per reading of its block (bytes): points, sorting and one tile's products."""
WORKER_BASE_BYTES: Final = 400 << 20
"""Memory of a worker before its first block (bytes): Python and its libraries."""
MOST_CELL_BYTES: Final = 800 << 20
"""Memory that the cells of active tiles may take (bytes)."""
