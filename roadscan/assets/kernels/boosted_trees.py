"""Sums over boosted trees."""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import kernel


@kernel
def tree_sums(rows, starts, feature, threshold, left, right, missing_left, value, out):
    """Compute the sum of the leaves that each row reaches, tree after tree.

    Parameters
    ----------
    rows : (n, k) float64, features of n segments; NaN where one is not known.
    starts : (t,) int32, the root of each tree among the nodes.
    feature : (m,) int32, column that a node asks for; −1 at a leaf.
    threshold : (m,) float64; a row whose feature is no greater goes to the left.
    left, right : (m,) int32, numbers of the next nodes.
    missing_left : (m,) bool, where a row goes whose feature is not known.
    value : (m,) float64, of leaves.
    out : (n,) float64.
    """
    for i in range(rows.shape[0]):
        total = 0.0
        for t in range(starts.size):
            node = starts[t]
            while feature[node] >= 0:
                x = rows[i, feature[node]]
                goes_left = missing_left[node] if math.isnan(x) else x <= threshold[node]
                node = left[node] if goes_left else right[node]
            total += value[node]
        out[i] = total
