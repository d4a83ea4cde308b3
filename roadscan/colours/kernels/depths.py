"""Depth images of points: the nearest in each pixel, and pieces of surface that close the gaps between them."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import kernel

DOUBT = 0.35
"""Share of the slope of a surface by which it may be steeper than its normal says: a degree, where it is seen flat."""
ROUGH = 1.0
"""Least slope (m a m across the ray) that is left to the relief of a surface."""


@kernel
def nearest_in_pixels(pixel, distance_m, rows, factor, image_m, which):
    """Keep the nearest distance in each pixel of an image; of equals the first.

    Parameters
    ----------
    pixel : (n, 2) float32, u and v in the picture.
    distance_m : (n,) float32, NaN where a point is not shown.
    rows : (m,) int64, the points that count.
    factor : pixels of the picture along the edge of one of the image.
    image_m : (height, width) float32, read and written, inf where nothing is.
    which : (height, width) int32, written: the point.
    """
    for k in range(rows.shape[0]):
        i = rows[k]
        if np.isnan(distance_m[i]):
            continue
        row, column = int((pixel[i, 1] + 0.5) / factor), int((pixel[i, 0] + 0.5) / factor)
        if row < image_m.shape[0] and column < image_m.shape[1] and distance_m[i] < image_m[row, column]:
            image_m[row, column] = distance_m[i]
            which[row, column] = i


@kernel
def slopes(sample_m, which, point_m, normal, camera_eye_m, axes, pixel_rad, steepest, unknown, slope):
    """Compute how the distance of the surface at each sample changes from pixel to pixel.

    The inverse distance of a plane is linear in the picture: that of a ray beside the sample's, over the sample's own,
    is 1 + (n · step) / (n · ray), with the unit normal n.

    Parameters
    ----------
    sample_m, which : (height, width), as `nearest_in_pixels` writes them.
    point_m : (n, 3) float32, map, from the origin of the eye.
    normal : (n, 3) float32, NaN where unknown.
    camera_eye_m : (3,) projection centre; axes : (3, 3) camera axes from the map.
    pixel_rad : angle of a pixel.
    steepest : most that the distance may change across a radian, as a share of it.
    unknown : that of a sample whose normal is not known, in all directions.
    slope : (height, width, 3) float32, written: change of the inverse distance a pixel to the right and downwards, as
        shares of it, and the growth of the distance a pixel that is allowed for beside that.
    """
    for i in range(sample_m.shape[0]):
        for j in range(sample_m.shape[1]):
            slope[i, j, 0] = 0.0
            slope[i, j, 1] = 0.0
            slope[i, j, 2] = unknown * pixel_rad
            if not np.isfinite(sample_m[i, j]):
                continue
            k = which[i, j]
            if math.isnan(normal[k, 0]):
                continue
            x = (point_m[k, 0] - camera_eye_m[0]) / sample_m[i, j]
            y = (point_m[k, 1] - camera_eye_m[1]) / sample_m[i, j]
            z = (point_m[k, 2] - camera_eye_m[2]) / sample_m[i, j]
            facing = normal[k, 0] * x + normal[k, 1] * y + normal[k, 2] * z
            right = normal[k, 0] * axes[0, 0] + normal[k, 1] * axes[0, 1] + normal[k, 2] * axes[0, 2]
            down = normal[k, 0] * axes[1, 0] + normal[k, 1] * axes[1, 1] + normal[k, 2] * axes[1, 2]
            ahead_right = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
            ahead_down = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
            right -= facing * ahead_right  # steps across the ray
            down -= facing * ahead_down
            steep = math.hypot(right, down)
            if steep > steepest * abs(facing):
                facing = math.copysign(max(steep / steepest, 1e-6), facing)
            slope[i, j, 0] = right / facing * pixel_rad
            slope[i, j, 1] = down / facing * pixel_rad
            slope[i, j, 2] = max(DOUBT * steep / abs(facing), ROUGH) * pixel_rad


@kernel
def grow(sample_m, slope, radius, block, image_m):
    """Close the gaps between samples with pieces of their surfaces.

    A sample becomes a disc that lies as its surface does and bends away from the eye with the distance from its middle.
    So a road seen flat does not hide itself, and a thing hides what is behind it between the places where it was hit.

    Parameters
    ----------
    sample_m : (height, width) float32, inf where nothing is.
    slope : (height, width, 3) float32, as `slopes` writes it.
    radius : (rows, columns) float32, radius of the discs by block of pixels (pixels).
    block : edge of a block (pixels).
    image_m : (height, width) float32, written, inf where no disc is.
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
            right, down, beside = slope[i, j, 0], slope[i, j, 1], slope[i, j, 2]
            for k in range(max(0, i - whole), min(height, i + whole + 1)):
                for m in range(max(0, j - whole), min(width, j + whole + 1)):
                    square = (k - i) * (k - i) + (m - j) * (m - j)
                    if square > reach * reach:
                        continue
                    inverse = max(1.0 + right * (m - j) + down * (k - i), 0.2)
                    value = np.float32(tip / inverse * (1.0 + beside * math.sqrt(square)))
                    image_m[k, m] = min(image_m[k, m], value)
