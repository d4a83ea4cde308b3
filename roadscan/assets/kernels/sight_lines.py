"""Occlusion between a camera and a place: a walk along the line through voxels that hide."""

from __future__ import annotations

import math

import numpy as np

from roadscan.compute.kernel_options import kernel


@kernel
def find_hidden(eye_m, place_m, epoch_gps_ns, keys, spans_gps_ns, shape, edge_m, limits_m, hidden):
    """Mark the places that are hidden from cameras.

    Parameters
    ----------
    eye_m, place_m : (n, 3) float64, from the corner of the voxels (m).
    epoch_gps_ns : (n,) int64, when each picture was taken.
    keys : (k,) int64 in ascending order, numbers (column · rows + row) · levels + level of voxels that hide; a number
        may occur twice.
    spans_gps_ns : (k, 2) int64, from when to when each does.
    shape : columns, rows and levels of the voxels.
    edge_m : edge of a voxel (m).
    limits_m : the line is walked from so far beyond the camera to so far before the place, and its step (m).
    hidden : (n,) bool, written.
    """
    for i in range(eye_m.shape[0]):
        dx, dy, dz = place_m[i, 0] - eye_m[i, 0], place_m[i, 1] - eye_m[i, 1], place_m[i, 2] - eye_m[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        hidden[i] = False
        before = -1
        steps = int((length - limits_m[1] - limits_m[0]) / limits_m[2])
        for step in range(max(steps, 0)):
            share = (limits_m[0] + step * limits_m[2]) / length
            column = math.floor((eye_m[i, 0] + share * dx) / edge_m)
            row = math.floor((eye_m[i, 1] + share * dy) / edge_m)
            level = math.floor((eye_m[i, 2] + share * dz) / edge_m)
            if not (0 <= column < shape[0] and 0 <= row < shape[1] and 0 <= level < shape[2]):
                continue
            key = (column * shape[1] + row) * shape[2] + level
            if key == before:
                continue
            before = key
            at = np.searchsorted(keys, key)
            while at < keys.size and keys[at] == key:
                if spans_gps_ns[at, 0] <= epoch_gps_ns[i] <= spans_gps_ns[at, 1]:
                    hidden[i] = True
                at += 1
            if hidden[i]:
                break
