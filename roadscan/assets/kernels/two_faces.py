"""Faces of what was seen from both sides, such as a wall between two carriageways: voxels that hold both are parted."""

from __future__ import annotations

import math

from roadscan.assets.kernels.upright_voxels import is_thin, plane_of, with_moments, write_element
from roadscan.compute.kernel_options import kernel


@kernel
def ask_for_faces(index, moments, side_m, elements, asked, normals):
    """Find voxels that may hold two faces, and the direction across what lies around them; returns how many.

    These are voxels that lie with those beside them on no plane. A direction is told from returns up to two voxels
    away: the returns of two faces lie as far across them as along them in fewer.

    index, moments, side_m, elements : as of `thin_elements`. asked : (voxels,) bool, all False, gets these voxels.
    normals : (voxels, 2) float64, all NaN, gets unit vectors seen from above of these and of the eight beside each.
    """
    layers, rows, columns = index.shape
    found = 0
    for k in range(layers):
        for r in range(rows):
            for c in range(columns):
                j = index[k, r, c]
                if j < 0 or elements[j, 0] > 0.0 or (elements[j, 3] == 0.0 and elements[j, 4] == 0.0):
                    continue
                asked[j] = True
                found += 1
                for rr in range(max(r - 1, 0), min(r + 2, rows)):
                    for cc in range(max(c - 1, 0), min(c + 2, columns)):
                        i = index[k, rr, cc]
                        if i >= 0 and math.isnan(normals[i, 0]):
                            total = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                            for v in range(max(rr - 2, 0), min(rr + 3, rows)):
                                for u in range(max(cc - 2, 0), min(cc + 3, columns)):
                                    q = index[k, v, u]
                                    if q >= 0:
                                        total = with_moments(total, moments, q, (u - cc) * side_m, (v - rr) * side_m)
                            plane = plane_of(total)
                            normals[i, 0], normals[i, 1] = -plane[3], plane[2]
    return found


@kernel
def gather_faces(x, y, sensor_x, sensor_y, voxel_of, normals, corner, side_m, moments, faces, face_of):
    """Sum the moments of both faces of voxels, and find which one each return lies on: the one that its sensor faces.

    x, y, sensor_x, sensor_y : (n,) float64 (m). voxel_of : (n,) int32. normals : as `ask_for_faces` has them.
    corner, side_m, moments : as of `gather_moments`. faces : (2 · voxels, 6) float64, all 0, gets two rows a voxel: n,
    Σx, Σy, Σx², Σxy, Σy². face_of : (n,) int8, gets 0 on the side to which the normal points, else 1.
    """
    for i in range(x.size):
        j = voxel_of[i]
        face_of[i] = 0
        if j < 0 or math.isnan(normals[j, 0]):
            continue
        if (sensor_x[i] - x[i]) * normals[j, 0] + (sensor_y[i] - y[i]) * normals[j, 1] < 0.0:
            face_of[i] = 1
        a = x[i] - corner[0] - moments[j, 9] * side_m
        b = y[i] - corner[1] - moments[j, 8] * side_m
        row = 2 * j + face_of[i]
        faces[row, 0] += 1.0
        faces[row, 1] += a
        faces[row, 2] += b
        faces[row, 3] += a * a
        faces[row, 4] += a * b
        faces[row, 5] += b * b


@kernel
def part_faces(index, asked, normals, faces, side_m, limits, least_cosine, elements, second):
    """Part voxels whose faces lie each on an upright plane; returns how many elements there are then.

    One of them is long enough for an element, and neither scatters more across its plane; both are parallel where both
    are long enough, and each lies on the side that it was seen from. So leaves, which scatter, stay as they are.

    index, side_m, limits : as of `thin_elements`. asked, normals, faces : as the kernels above have them.
    least_cosine : of the angle between both. elements : (2 · voxels, 6) float64, gets those of parted voxels: of the
    face 0 in place of the voxel's, of the face 1 behind all voxels. second : (voxels,) int32, all -1, gets the number
    of the latter.
    """
    layers, rows, columns = index.shape
    last = asked.size
    for k in range(layers):
        for r in range(rows):
            for c in range(columns):
                j = index[k, r, c]
                if j < 0 or not asked[j]:
                    continue
                first = other = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for rr in range(max(r - 1, 0), min(r + 2, rows)):
                    for cc in range(max(c - 1, 0), min(c + 2, columns)):
                        i = index[k, rr, cc]
                        if i >= 0:
                            turned = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] < 0.0
                            a, b = (cc - c) * side_m, (rr - r) * side_m
                            first = with_moments(first, faces, 2 * i + turned, a, b)
                            other = with_moments(other, faces, 2 * i + 1 - turned, a, b)
                if first[0] == 0.0 or other[0] == 0.0:
                    continue
                one, two = plane_of(first), plane_of(other)
                thin = first[0] >= limits[0] and is_thin(one, limits)
                thin_too = other[0] >= limits[0] and is_thin(two, limits)
                if not (thin or thin_too):
                    continue
                if (first[0] >= limits[0] and one[5] > limits[2]) or (other[0] >= limits[0] and two[5] > limits[2]):
                    continue
                if thin and thin_too and abs(one[2] * two[2] + one[3] * two[3]) < least_cosine:
                    continue
                if (one[0] - two[0]) * normals[j, 0] + (one[1] - two[1]) * normals[j, 1] <= 0.0:
                    continue
                write_element(elements, j, one, thin, c * side_m, r * side_m)
                write_element(elements, last, two, thin_too, c * side_m, r * side_m)
                second[j] = last
                last += 1
    return last
