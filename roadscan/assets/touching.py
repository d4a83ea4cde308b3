"""Connected components of cells."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Int64


def touching(flat: Int64, steps: Iterable[int]) -> npt.NDArray[np.int32]:
    """Returns the number (n,) of the connected piece of each cell.

    Parameters
    ----------
    flat : (n,) numbers of the cells, ascending, each once: rows and layers apart so far that no step leaves them.
    steps : differences of the numbers of cells that touch, those that are positive.
    """
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    edges = [np.empty((0, 2), np.int64)]
    for step in steps:
        at = np.searchsorted(flat, flat + step)
        met = (at < flat.size) & (flat[np.minimum(at, flat.size - 1)] == flat + step)
        edges.append(np.column_stack([np.flatnonzero(met), at[met]]))
    joined = np.concatenate(edges)
    graph = sparse.coo_matrix((np.ones(len(joined), np.int8), (joined[:, 0], joined[:, 1])), shape=(flat.size,) * 2)
    label: npt.NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return label
