"""Transects outward from a line over the raster of the ground: extent of the surface, and what ends it."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel

RESULTS = 5  # Number of columns.
WIDTH, END, OUTER_HEIGHT, SLOPE, MIDDLE_HEIGHT = range(RESULTS)
UNSEEN, OBSTACLE, STEP_DOWN, STEP_UP, BENT, FAR = range(6)
"""Ends of a transect: nothing known, an object, an edge down or up, a bend or a rough place, none."""


@kernel
def walk(node, height_m, rough_m, blocked, edge_x, edge_y, grid, limits, out):
    """Fill `out` (n, RESULTS): width (m), its end, height at the end (m), slope outward (m/m), height in the middle.

    node : (n, 4) x, y (m) and the unit vector outward. height_m, rough_m : (rows, columns) smooth height, NaN where
    nothing is known near, and roughness (m). blocked : cells where something stands. edge_x, edge_y : unit vector to
    the higher side of an edge in the cell, 0 where there is none. grid : (x_min_m, y_min_m, cell_m). limits : (first
    and last distance (m), hole (m), greatest slope (m/m), greatest roughness (m)).
    """
    rows, columns = height_m.shape
    step = grid[2]
    count = int(limits[1] / step)
    levels = np.empty(count + 1)
    for i in range(node.shape[0]):
        known_at, end, hole = 0.0, float(FAR), 0.0
        n, s1, s2, z1, zs = 0.0, 0.0, 0.0, 0.0, 0.0
        levels[:] = np.nan
        for k in range(1, count + 1):
            t = limits[0] + (k - 1) * step
            if t > limits[1]:
                break
            c = int(np.floor((node[i, 0] + t * node[i, 2] - grid[0]) / step))
            r = int(np.floor((node[i, 1] + t * node[i, 3] - grid[1]) / step))
            if not (0 <= c < columns and 0 <= r < rows):
                end = UNSEEN
                break
            if blocked[r, c]:
                end = OBSTACLE
                break
            if t > limits[0] + 0.15 and (edge_x[r, c] != 0.0 or edge_y[r, c] != 0.0):
                outward = edge_x[r, c] * node[i, 2] + edge_y[r, c] * node[i, 3]
                if outward < -0.5:
                    end, known_at = STEP_DOWN, t
                    break
                if outward > 0.5:
                    end, known_at = STEP_UP, t
                    break
            z = height_m[r, c]
            if np.isnan(z):
                hole += step
                if hole > limits[2]:
                    end = UNSEEN
                    break
                continue
            hole = 0.0
            levels[k] = z
            before = levels[k - 5] if k > 5 else np.nan
            if rough_m[r, c] > limits[4] or abs(z - before) > limits[3] * 5.0 * step:
                end = BENT
                # Smooth heights bend before the edge.
                for m in range(1, 6):
                    ahead = t + m * step
                    c = int(np.floor((node[i, 0] + ahead * node[i, 2] - grid[0]) / step))
                    r = int(np.floor((node[i, 1] + ahead * node[i, 3] - grid[1]) / step))
                    if 0 <= c < columns and 0 <= r < rows:
                        outward = edge_x[r, c] * node[i, 2] + edge_y[r, c] * node[i, 3]
                        if abs(outward) > 0.5:
                            end, known_at = STEP_DOWN if outward < 0.0 else STEP_UP, ahead
                            break
                break
            known_at = t
            n += 1.0
            s1 += t
            s2 += t * t
            z1 += z
            zs += z * t
        spread = n * s2 - s1 * s1
        slope = (n * zs - s1 * z1) / spread if n >= 3.0 and spread > 0.0 else np.nan
        mean = z1 / n if n > 0.0 else np.nan
        out[i, WIDTH], out[i, END], out[i, SLOPE] = known_at, end, slope
        out[i, OUTER_HEIGHT] = mean + slope * (known_at - s1 / n) if n >= 3.0 else mean
        out[i, MIDDLE_HEIGHT] = mean
