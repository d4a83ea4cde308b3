"""Depth images of points: the nearest in each pixel, and cones that close the gaps between them."""

from __future__ import annotations

import numpy as np

from roadscan.compute.kernel_options import kernel


@kernel
def nearest_in_pixels(pixel, distance_m, rows, factor, image_m):
    """Keep the nearest distance in each pixel of an image.

    Parameters
    ----------
    pixel : (n, 2) float32, u and v in the picture.
    distance_m : (n,) float32, NaN where a point is not shown.
    rows : (m,) int64, the points that count.
    factor : pixels of the picture along the edge of one of the image.
    image_m : (height, width) float32, read and written, inf where nothing is.
    """
    for k in range(rows.shape[0]):
        i = rows[k]
        if np.isnan(distance_m[i]):
            continue
        row, column = int((pixel[i, 1] + 0.5) / factor), int((pixel[i, 0] + 0.5) / factor)
        if row < image_m.shape[0] and column < image_m.shape[1] and distance_m[i] < image_m[row, column]:
            image_m[row, column] = distance_m[i]


@kernel
def grow(sample_m, radius, block, slope, image_m):
    """Close the gaps between samples with cones, whose tips are the samples and which open away from the eye.

    A cone is as steep as the flattest surface that counts as seen, so that a road does not hide itself, and a thing
    hides what is behind it also between the places where it was hit.

    Parameters
    ----------
    sample_m : (height, width) float32, inf where nothing is.
    radius : (rows, columns) float32, radius of the cones by block of pixels (pixels).
    block : edge of a block (pixels).
    slope : growth of the distance a pixel, as a share of it.
    image_m : (height, width) float32, written, inf where no cone is.
    """
    height, width = sample_m.shape
    image_m[:] = np.inf
    for i in range(height):
        for j in range(width):
            tip = sample_m[i, j]
            if not np.isfinite(tip):
                continue
            reach = radius[i // block, j // block]
            whole = int(reach)
            for k in range(max(0, i - whole), min(height, i + whole + 1)):
                for m in range(max(0, j - whole), min(width, j + whole + 1)):
                    square = (k - i) * (k - i) + (m - j) * (m - j)
                    if square > reach * reach:
                        continue
                    value = np.float32(tip * (1.0 + slope * np.sqrt(square)))
                    if value < image_m[k, m]:
                        image_m[k, m] = value
