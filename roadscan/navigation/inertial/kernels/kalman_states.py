"""Structures that the filter and the smoother of an inertial navigation system work on.

Errors are what has to be added to the nominal state: position and velocity in ECEF axes, attitude as a small rotation
ψ about ECEF axes (true = exp(ψ×) · nominal), biases and scales in the IMU's axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.compute.kernel_options import inlined
from roadscan.navigation.inertial.kernels.strapdown import geodetic

POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCEL_BIAS = 0, 3, 6, 9, 12  # First columns of these states, three each.
GYRO_SCALE, ACCEL_SCALE = 15, 18
"""First columns of the scale states, which exist only where the layout has 21 inertial states."""
NAVIGATION = 9
"""Number of states that a mechanisation carries: position, velocity, attitude."""
WITHOUT_SCALES = 15  # Inertial states of a layout without scales.

GNSS_POSITION, GNSS_VELOCITY, ODOMETER, NON_HOLONOMIC, ZERO_VELOCITY, ZERO_ROTATION = 0, 1, 2, 3, 4, 5  # Kinds.
KINDS = 6  # Number of these kinds.


class Layout(NamedTuple):
    """Columns of the optional states, −1 for missing ones."""

    size: int
    """Number of states."""
    inertial: int
    """States that a transition mixes: 15, with scales 21."""
    antenna: int
    """Lever arm of the antenna from the IMU, body axes (3)."""
    axle: int
    """Lever arm of the point that moves only forwards, from the IMU, body axes (3)."""
    tilt: int
    """Pitch and heading of the direction of travel against the body's axes (2)."""
    scale: int
    """Scale error of the odometer (1)."""
    colour: int
    """Time-correlated error of the GNSS position, north, east, down, in units of its σ (3)."""
    delay: int
    """Lead of the IMU's stamps over GNSS time (1, s)."""
    lag: int
    """Delay of the velocities of GNSS relative to its positions (1, s)."""


class Steps(NamedTuple):
    """The s steps of the mechanisation."""

    seconds: Float64
    turn: Float64
    """(s, 3) rad, IMU axes, as from :func:`roadscan.navigation.inertial.kernels.strapdown.increments`."""
    push: Float64
    """(s, 3) m/s."""
    loose: Float64
    """(s,) seconds without a sample."""


class Nodes(NamedTuple):
    """The k nodes at which covariances are computed; the first is the start."""

    bound: Int64
    """(k,) number of steps before it."""
    colour_keep: Float64
    """(k,) share of the coloured GNSS error that remains over the interval that ends there, 0 to 1."""
    gnss: Int64
    """(k,) row of `Fixes`, −1 for none."""
    still: npt.NDArray[np.bool_]
    """(k,) True where the vehicle stood over the interval that ends there."""
    travel: Float64
    """(k,) metres that the odometer counted over the interval, NaN where there is none."""
    constrained: npt.NDArray[np.bool_]
    """(k,) True where the non-holonomic constraint applies to the interval."""
    report: Int64
    """(k,) row of the reported states, −1 for none."""
    rate_noise: Float64
    """(k, 3) noise of the gyroscopes over the interval, IMU axes, rad²/s."""
    force_noise: Float64
    """(k, 3) noise of the accelerometers, m²/s³."""


class Fixes(NamedTuple):
    """GNSS solutions, m of them."""

    position: Float64
    """(m, 3) ECEF, m; NaN for none."""
    white: Float64
    """(m, 3, 3) covariance of the part that is independent between epochs, north-east-down, m²."""
    coloured: Float64
    """(m, 3) σ of the part that is correlated in time, m."""
    velocity: Float64
    """(m, 3) north-east-down, m/s; NaN for none."""
    velocity_variance: Float64
    """(m, 3) m²/s²."""


class Model(NamedTuple):
    """Noise and geometry."""

    gyro_bias: float
    """1 σ, rad/s."""
    accel_bias: float
    """1 σ, m/s²."""
    bias_seconds: float
    """Time constant of both biases."""
    body_from_imu: Float64
    """(3, 3)."""
    travel_sigma: float
    """1 σ of the odometer's speed, m/s."""
    travel_share: float
    """Part of it that grows with speed (slip)."""
    side_sigma: float
    """1 σ of the non-holonomic constraint to the side, m/s."""
    side_slip: float
    """Side-slip angle of the axle for each m/s² of acceleration to the side, rad."""
    up_sigma: float
    """1 σ of the non-holonomic constraint upwards, m/s."""
    zero_sigma: float
    """1 σ of a standing vehicle's velocity, m/s."""
    zero_rate_sigma: float
    """1 σ of its rotation, rad/s."""
    loose_rate: float
    """Unmeasured rotation in a gap of the IMU, rad/s."""
    loose_force: float
    """Unmeasured acceleration in it, m/s²."""
    outlier: Float64
    """(4,) squared normalised innovation by component above which an update of 1, 2, 3 components is down-weighted."""
    patience_s: float
    """After positions were down-weighted for this long in a row, they get full weight: then the filter errs."""
    delay_wander: float
    """Random walk of the IMU's clock, s/√s."""
    interval_s: float
    """Interval for which the σ of constraints are stated; their noise is white, so longer intervals weigh more."""


class Start(NamedTuple):
    """State at the first node."""

    quaternion: Float64
    """(4,) ECEF from IMU."""
    velocity: Float64
    position: Float64
    values: Float64
    """(n − 9,) nominal values of the states after attitude."""
    covariance: Float64
    """(n, n)."""


class Track(NamedTuple):
    """Nominal states at all bounds, before the update of a node."""

    quaternion: Float64
    """(s + 1, 4) ECEF from IMU."""
    velocity: Float64
    """(s + 1, 3)."""
    position: Float64
    """(s + 1, 3)."""
    rate: Float64
    """(s + 1, 3) rad/s against inertial space, IMU axes, over the step that ends there."""


class Record(NamedTuple):
    """The filter's record for the smoother."""

    transition: Float64
    """(k, 9, inertial) of the interval that ends at a node."""
    keep: Float64
    """(k,) of the biases."""
    rows: Float64
    """(k, 9, n) covariance of navigation states with all states, after the node's updates."""
    applied: Float64
    """(k, 9) correction of the nominal state by the node's updates."""
    first_update: Int64
    """(k + 1,)."""
    values: Float64
    """(j, n − 9) at the reported nodes, nominal."""
    covariance: Float64
    """(j, n, n) there."""


class Updates(NamedTuple):
    """All u updates in their order."""

    row: Float64
    """(u, 3, n) whitened L⁻¹ H."""
    gain: Float64
    """(u, 3, n) whitened (P Hᵀ L⁻ᵀ)ᵀ."""
    innovation: Float64
    """(u, 3) whitened L⁻¹ y."""
    size: Int64
    """(u,) number of components."""
    kind: Int64
    node: Int64
    residual: Float64
    """(u, 3) residual that is reported."""
    normalised: Float64
    weight: Float64


class Present(NamedTuple):
    """The filter's state, changed in place."""

    quaternion: Float64
    """(4,) ECEF from IMU."""
    velocity: Float64
    """(3,) m/s."""
    position: Float64
    """(3,) m."""
    values: Float64
    """(n − 9,) the other states."""
    covariance: Float64
    """(n, n)."""


class Interval(NamedTuple):
    """Integrals over the steps between two nodes."""

    sums: Float64
    """(10, 3, 3): 0 ∫C, 1 ∫C diag(ω), 2 ∫C diag(f), 3 ∫[f×]∫C, 4 ∫[f×]∫C diag(ω), 5…8 integrals of 0, 2, 3, 4,
    9 ∫Cᵀ[v×]; C turns the IMU's axes into ECEF."""
    ways: Float64
    """(4, 3): 0 ∫f, 1 ∫∫f (ECEF), 2 ∫ω, 3 ∫Cᵀv (IMU axes)."""
    acceleration: Float64
    """(3,) mean acceleration, ECEF, m/s²."""
    length: Float64
    """(2,) its length and the longest silence of the IMU within, s."""


class Offer(NamedTuple):
    """A measurement offered to the filter: innovation = row · errors + noise."""

    row: Float64
    """(3, n)."""
    noise: Float64
    """(3, 3)."""
    innovation: Float64
    """(3,)."""
    body: Float64
    """(3, 3) ECEF from body."""
    level: Float64
    """(3, 3) ECEF from north-east-down."""
    shift: Float64
    """(n,) correction of the states."""


@inlined
def cross_rows(x, y, z, out, top, left, sign):
    """Write out[top:, left:] = sign · [x y z]×."""
    out[top, left], out[top, left + 1], out[top, left + 2] = 0.0, -sign * z, sign * y
    out[top + 1, left], out[top + 1, left + 1], out[top + 1, left + 2] = sign * z, 0.0, -sign * x
    out[top + 2, left], out[top + 2, left + 1], out[top + 2, left + 2] = -sign * y, sign * x, 0.0


@inlined
def decays(bias_keep, colour_keep, layout, out):
    """Write (n,) the share of each state after attitude that remains over an interval."""
    for i in range(out.size):
        out[i] = bias_keep if GYRO_BIAS <= i < WITHOUT_SCALES else 1.0
    if layout.colour >= 0:
        for i in range(layout.colour, layout.colour + 3):
            out[i] = colour_keep


@inlined
def level_axes(x, y, z, out):
    """Write ECEF from north-east-down at a position (Groves 2013, eq. 2.150)."""
    s_lat, c_lat, s_lon, c_lon, _ = geodetic(x, y, z)
    out[0, 0], out[0, 1], out[0, 2] = -s_lat * c_lon, -s_lon, -c_lat * c_lon
    out[1, 0], out[1, 1], out[1, 2] = -s_lat * s_lon, c_lon, -c_lat * s_lon
    out[2, 0], out[2, 1], out[2, 2] = c_lat, 0.0, -s_lat
