"""A change of a mounting: where it puts points, by the changed mounting and by the derivatives of the adjustment."""

from __future__ import annotations

import numpy as np
import pytest

from roadscan.adjust.observations import mount_partials
from roadscan.core.frames import rotation_from_rph
from roadscan.core.rig import Mounting, Mountings
from roadscan.poses.trajectory import MountingChange, Seat

VALUES = np.array([0.0003, -0.0002, 0.0004, 2e-5, -3e-5, 4e-5, 8e-5])
ROTATION, LEVER = rotation_from_rph(0.2, -0.1, 0.3), np.array([-1.2, 0.8, -1.1])


@pytest.mark.parametrize("parallel", [True, False])
def test_points_move_as_the_derivatives_say(parallel: bool) -> None:
    """Readings of a head whose beams are along z, and of one whose beams fan out, through the changed mounting."""
    rng = np.random.default_rng(3)
    seen = rng.uniform(-2.0, 2.0, (20, 3)) * [0.0, 1.0, 0.5] + [0.0, 0.0, 2.0]
    change = MountingChange.of(VALUES)
    np.testing.assert_array_equal(change.values, VALUES)
    rows = tuple((float(r[0]), float(r[1]), float(r[2])) for r in ROTATION)
    stated = Mountings.one(Mounting((-1.2, 0.8, -1.1), rows))
    rotation, lever = change.applied(stated, parallel=parallel).mountings[0].arrays()
    before, after = seen @ ROTATION.T + LEVER, seen @ rotation.T + lever
    # A head's own scale lengthens what it measures: z alone where its beams are parallel.
    longer = seen * np.where(parallel, [1.0, 1.0, 1.0 + VALUES[6]], 1.0 + VALUES[6])
    np.testing.assert_allclose((after - lever) @ ROTATION, longer, atol=3e-4)
    seat = Seat(LEVER, ROTATION[:, 2] if parallel else np.full(3, np.nan))
    np.testing.assert_allclose(change.moves_level(np.broadcast_to(np.eye(3), (20, 3, 3)), before, seat),
                               after - before, atol=2e-8)  # fmt: skip
    direction = rng.standard_normal((20, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    along = np.einsum("ni,ni->n", before, direction)
    by, by_range = mount_partials(direction, np.cross(before, direction), along, seat)
    np.testing.assert_allclose(by @ VALUES, np.einsum("ni,ni->n", after - before, direction), atol=2e-8)
    # A reading that is a metre longer lies a metre farther along its beam.
    beams = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    farther = (seen + np.where(parallel, np.sign(seen[:, 2:]) * [0.0, 0.0, 1.0], beams)) @ ROTATION.T + LEVER
    np.testing.assert_allclose(by_range, np.einsum("ni,ni->n", farther - before, direction), atol=1e-12)
