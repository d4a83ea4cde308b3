"""Draws grey pictures of a tile's cells; 0 is empty, 1 to 255 are values."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import inlined, kernel

EMPTY = np.uint8(0)  # Grey of a pixel without a cell.

ONE, TWO = np.float32(1.0), np.float32(2.0)  # In the type of the heights, so that arithmetic stays in 32 bits.
DARKEST, STEPS = np.float32(1.5), np.float32(254.0)
"""Grey is DARKEST plus this many steps, rounded down."""


@kernel
def grey_intensity(column, row, intensity, black, white, west, north, picture):
    """Draw each cell's intensity: 1 at `black` and below, 255 at `white` and above, even steps between.

    Parameters
    ----------
    column, row : (n,) uint16; intensity : (n,) float32, digital numbers; black < white : float64.
    west, north : int, column of the picture's first pixel and row of its first line.
    picture : (rows, columns) uint8, zeros, north up; in/out.
    """
    scale = 254.0 / (white - black)
    for i in range(row.size):
        grey = min(max((intensity[i] - black) * scale, 0.0), 254.0)
        picture[north - np.int64(row[i]), np.int64(column[i]) - west] = np.uint8(grey + 1.5)


@inlined
def continued(near, opposite, centre):
    """Return a neighbour's height; if missing, the surface continues from the opposite one, or is level."""
    other = centre if np.isnan(opposite) else TWO * centre - opposite
    return other if np.isnan(near) else near


@inlined
def shade_line(south, here, north, east_scale, north_scale, light_east, light_north, light_up, line):
    """Shade one line of cells; all three lines have one more cell on either side, NaN where unknown.

    The brightness of a matt surface: the cosine between its normal and the direction of the light. Slopes are the
    weighted differences of Horn, *Hill shading and the reflectance map* (Proc. IEEE 69, 1981), with weights 1, 2, 1.
    """
    for k in range(line.size):
        centre = here[k + 1]
        sw = continued(south[k], north[k + 2], centre)
        s = continued(south[k + 1], north[k + 1], centre)
        se = continued(south[k + 2], north[k], centre)
        w = continued(here[k], here[k + 2], centre)
        e = continued(here[k + 2], here[k], centre)
        nw = continued(north[k], south[k + 2], centre)
        n = continued(north[k + 1], south[k + 1], centre)
        ne = continued(north[k + 2], south[k], centre)
        east = ((ne + TWO * e + se) - (nw + TWO * w + sw)) * east_scale
        up = ((nw + TWO * n + ne) - (sw + TWO * s + se)) * north_scale
        towards = light_up - (light_east * east + light_north * up)
        bright = max(towards / np.sqrt(ONE + east * east + up * up), np.float32(0.0))
        line[k] = np.uint8(DARKEST + STEPS * bright) if not np.isnan(centre) else EMPTY


@kernel
def shade_raster(heights, east_scale, north_scale, light_east, light_north, light_up, picture):
    """Draw shaded relief of a raster, both north up.

    Parameters
    ----------
    heights : (rows + 2, columns + 2) float64, m, NaN where unknown.
    east_scale, north_scale : float64, exaggeration / (8 · edge of a cell in m) towards each.
    light_east, light_north, light_up : float64, unit vector towards the light.
    picture : (rows, columns) uint8, out.
    """
    for line in range(picture.shape[0]):
        shade_line(
            heights[line + 2], heights[line + 1], heights[line], east_scale, north_scale, light_east, light_north,
            light_up, picture[line],
        )  # fmt: skip


@kernel
def shade_cells(
    column, row, height, base, slope_scale, light_east, light_north, light_up, west, north, heights, picture
):
    """Draw shaded relief of a tile's cells (Horn 1981, weights 1, 2, 1), with three lines in memory at a time.

    Parameters
    ----------
    column, row : (n,) uint16, sorted by row, column; height : (n,) float64, m, in the map frame.
    base : float64, m, a height near them.
    slope_scale : float32, exaggeration / (8 · edge of a cell in m).
    light_east, light_north, light_up : float32, unit vector towards the light.
    west, north : int, column of the picture's first pixel and row of its first line.
    heights : (3, columns + 2) float32, overwritten.
    picture : (rows, columns) uint8, out, north up.
    """
    rows = picture.shape[0]
    heights[:] = np.nan
    at = 0
    for line in range(-1, rows):  # from the south; a line is shaded once the line above it is filled
        above = heights[(line + 1) % 3]
        above[:] = np.nan
        wanted = north - rows + 2 + line
        while at < row.size and row[at] == wanted:
            above[np.int64(column[at]) - west + 1] = height[at] - base
            at += 1
        if line >= 0:
            shade_line(
                heights[(line + 2) % 3], heights[line % 3], above, slope_scale, slope_scale, light_east, light_north,
                light_up, picture[rows - 1 - line],
            )  # fmt: skip
