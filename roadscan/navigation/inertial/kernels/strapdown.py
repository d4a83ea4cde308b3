"""Strapdown mechanisation in ECEF axes, and the increments that it uses.

Attitude is a quaternion (scalar first) that turns vectors of the IMU into ECEF; velocity is over ground. One step
takes a rotation vector and a velocity increment (Groves 2013, section 5.3; coning and sculling: Savage 1998,
"Strapdown inertial navigation integration algorithm design", parts 1 and 2). ECEF has no singular place: the
same formulas hold at the poles.
"""

from __future__ import annotations

import math

from roadscan.compute.kernel_options import inlined, kernel

EARTH_RATE_RAD_PER_S = 7.292115e-5  # WGS 84.
SEMI_MAJOR_M = 6378137.0  # Semi-major axis of WGS 84.
FLATTENING = 1.0 / 298.257223563  # Flattening of WGS 84.
ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)  # First eccentricity squared.
SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)  # Semi-minor axis.
GRAVITY_EQUATOR_M_PER_S2 = 9.7803253359  # Normal gravity at the equator, WGS 84.
SOMIGLIANA = 0.001931853  # Constant of Somigliana's formula, WGS 84.
CENTRIFUGAL = 0.00344978650684
"""ω² a² b / GM of WGS 84."""


@inlined
def product(q, p):
    """Return the quaternion product q ⊗ p."""
    return (
        q[0] * p[0] - q[1] * p[1] - q[2] * p[2] - q[3] * p[3],
        q[0] * p[1] + q[1] * p[0] + q[2] * p[3] - q[3] * p[2],
        q[0] * p[2] - q[1] * p[3] + q[2] * p[0] + q[3] * p[1],
        q[0] * p[3] + q[1] * p[2] - q[2] * p[1] + q[3] * p[0],
    )


@inlined
def exponential(x, y, z):
    """Return the unit quaternion of a rotation vector (rad)."""
    a = x * x + y * y + z * z
    if a < 1e-3:
        w = 1.0 - a * (0.125 - a / 384.0)
        s = 0.5 - a * (1.0 / 48.0 - a / 3840.0)
    else:
        angle = math.sqrt(a)
        w, s = math.cos(0.5 * angle), math.sin(0.5 * angle) / angle
    return w, s * x, s * y, s * z


@inlined
def unit(q):
    """Return the quaternion normalised to length one."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale


@inlined
def matrix(q):
    """Return the rotation matrix of a unit quaternion, row by row."""
    w, x, y, z = q
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@inlined
def geodetic(x, y, z):
    """Return sine and cosine of latitude, sine and cosine of longitude, ellipsoidal height (m) of an ECEF position.

    Bowring (1985), one step: below 1 nm near the Earth's surface.
    """
    p = math.hypot(x, y)
    reduced = math.atan2(z * SEMI_MAJOR_M * (1.0 + ECCENTRICITY2 / (1.0 - ECCENTRICITY2) * SEMI_MINOR_M
                         / math.hypot(p, z)), p * SEMI_MINOR_M)  # fmt: skip
    sine, cosine = math.sin(reduced), math.cos(reduced)
    north = z + ECCENTRICITY2 / (1.0 - ECCENTRICITY2) * SEMI_MINOR_M * sine * sine * sine
    out = p - ECCENTRICITY2 * SEMI_MAJOR_M * cosine * cosine * cosine
    length = math.hypot(north, out)
    s_lat, c_lat = north / length, out / length
    height = p * c_lat + z * s_lat - SEMI_MAJOR_M * math.sqrt(1.0 - ECCENTRICITY2 * s_lat * s_lat)
    if p > 0.0:
        s_lon, c_lon = y / p, x / p
    else:
        s_lon, c_lon = 0.0, 1.0
    return s_lat, c_lat, s_lon, c_lon, height


@kernel
def gravity_at(x, y, z):
    """Return normal gravity (m/s², downwards positive) and the upward unit vector, ECEF.

    Somigliana on the ellipsoid, second order in height (Groves 2013, eq. 2.134, 2.139).
    """
    s_lat, c_lat, s_lon, c_lon, height = geodetic(x, y, z)
    s2 = s_lat * s_lat
    on_ellipsoid = GRAVITY_EQUATOR_M_PER_S2 * (1.0 + SOMIGLIANA * s2) / math.sqrt(1.0 - ECCENTRICITY2 * s2)
    share = height / SEMI_MAJOR_M
    size = on_ellipsoid * (
        1.0 - 2.0 * share * (1.0 + FLATTENING * (1.0 - 2.0 * s2) + CENTRIFUGAL) + 3.0 * share * share
    )
    return size, c_lat * c_lon, c_lat * s_lon, s_lat


@inlined
def gravity_near(field, x, y, z):
    """Return the gravity vector (m/s², ECEF) close to the place where `field` = (size, up, x, y, z) was computed.

    It turns with the vertical and falls with height: Δg = −g/r (Δx − 3 up (up · Δx)).
    """
    size, ux, uy, uz, x0, y0, z0 = field
    dx, dy, dz = x - x0, y - y0, z - z0
    k = size / SEMI_MAJOR_M
    up = 3.0 * (ux * dx + uy * dy + uz * dz)
    return -size * ux - k * (dx - up * ux), -size * uy - k * (dy - up * uy), -size * uz - k * (dz - up * uz)


@inlined
def gravity_field(x, y, z):
    """Return the field from which :func:`gravity_near` starts."""
    size, ux, uy, uz = gravity_at(x, y, z)
    return size, ux, uy, uz, x, y, z


@inlined
def strapdown_step(q, v, r, turn, push, dt, field):
    """Compute one step of the mechanisation.

    Parameters
    ----------
    q, v, r : attitude (ECEF from IMU), velocity (m/s, ECEF), position (m, ECEF).
    turn : rotation vector of the step, IMU axes, coning included (rad).
    push : velocity increment of the step, IMU axes, sculling included, its rotation not (m/s).
    dt : length of the step (s); field : :func:`gravity_field` nearby.

    Returns
    -------
    q, v, r after it, and the velocity increment in ECEF.
    """
    px = push[0] + 0.5 * (turn[1] * push[2] - turn[2] * push[1])
    py = push[1] + 0.5 * (turn[2] * push[0] - turn[0] * push[2])
    pz = push[2] + 0.5 * (turn[0] * push[1] - turn[1] * push[0])
    c = matrix(q)
    fx = c[0] * px + c[1] * py + c[2] * pz
    fy = c[3] * px + c[4] * py + c[5] * pz
    fz = c[6] * px + c[7] * py + c[8] * pz
    half = 0.5 * EARTH_RATE_RAD_PER_S * dt
    fx, fy = fx + half * fy, fy - half * fx
    gx, gy, gz = gravity_near(field, r[0] + 0.5 * dt * v[0], r[1] + 0.5 * dt * v[1], r[2] + 0.5 * dt * v[2])
    # Coriolis with the velocity at the middle of the step.
    mx, my = v[0] + 0.5 * (fx + gx * dt), v[1] + 0.5 * (fy + gy * dt)
    vx = v[0] + fx + (gx + 2.0 * EARTH_RATE_RAD_PER_S * my) * dt
    vy = v[1] + fy + (gy - 2.0 * EARTH_RATE_RAD_PER_S * mx) * dt
    vz = v[2] + fz + gz * dt
    moved = (r[0] + 0.5 * dt * (v[0] + vx), r[1] + 0.5 * dt * (v[1] + vy), r[2] + 0.5 * dt * (v[2] + vz))
    turned = product(q, exponential(turn[0], turn[1], turn[2]))
    turned = unit(product((1.0, 0.0, 0.0, -half), turned))
    return turned, (vx, vy, vz), moved, (fx, fy, fz)


@kernel
def increments(epochs, rate, force, instant, bounds, steps, turn, push):
    """Compute rotation and velocity increments of the steps between `bounds`, coning and sculling included.

    Rates and forces change linearly within a sample: what two samples in a row say (Savage 1998, part 1, eq. 41;
    part 2, eq. 39). A sample that a bound divides gives each part its share.

    Parameters
    ----------
    epochs : (n,) int64, ns; rate, force : (n, 3) rad/s, m/s².
    instant : bool; True where samples hold at their epoch, False where they are means since the one before.
    bounds : (b,) int64, ascending, within the epochs, with all epochs between its ends.
    steps : (b − 1,) s, turn, push : (b − 1, 3) rad, m/s, out.
    """
    i = 1
    while epochs[i] <= bounds[0]:
        i += 1
    fresh = -1
    ax = ay = az = bx = by = bz = 0.0
    for s in range(steps.size):
        while epochs[i] < bounds[s + 1]:
            i += 1
        dt = (bounds[s + 1] - bounds[s]) * 1e-9
        if i != fresh:
            fresh = i
            whole = (epochs[i] - epochs[i - 1]) * 1e-9
            w0, w1 = (rate[i - 1, 0], rate[i - 1, 1], rate[i - 1, 2]), (rate[i, 0], rate[i, 1], rate[i, 2])
            f0, f1 = (force[i - 1, 0], force[i - 1, 1], force[i - 1, 2]), (force[i, 0], force[i, 1], force[i, 2])
            k = whole / 12.0
            ax = k * (w0[1] * w1[2] - w0[2] * w1[1])
            ay = k * (w0[2] * w1[0] - w0[0] * w1[2])
            az = k * (w0[0] * w1[1] - w0[1] * w1[0])
            bx = k * (w0[1] * f1[2] - w0[2] * f1[1] + f0[1] * w1[2] - f0[2] * w1[1])
            by = k * (w0[2] * f1[0] - w0[0] * f1[2] + f0[2] * w1[0] - f0[0] * w1[2])
            bz = k * (w0[0] * f1[1] - w0[1] * f1[0] + f0[0] * w1[1] - f0[1] * w1[0])
            if instant:
                ax, ay, az = ax + 0.5 * (w0[0] + w1[0]), ay + 0.5 * (w0[1] + w1[1]), az + 0.5 * (w0[2] + w1[2])
                bx, by, bz = bx + 0.5 * (f0[0] + f1[0]), by + 0.5 * (f0[1] + f1[1]), bz + 0.5 * (f0[2] + f1[2])
            else:
                ax, ay, az = ax + w1[0], ay + w1[1], az + w1[2]
                bx, by, bz = bx + f1[0], by + f1[1], bz + f1[2]
        steps[s] = dt
        turn[s, 0], turn[s, 1], turn[s, 2] = ax * dt, ay * dt, az * dt
        push[s, 0], push[s, 1], push[s, 2] = bx * dt, by * dt, bz * dt


@kernel
def geodetic_of(positions, out):
    """Compute (n, 5) sine and cosine of latitude and longitude, and height, of ECEF positions (n, 3)."""
    for i in range(positions.shape[0]):
        found = geodetic(positions[i, 0], positions[i, 1], positions[i, 2])
        for j in range(5):
            out[i, j] = found[j]


@kernel
def turned_frame(turn, push, quaternions, velocities):
    """Compute attitudes relative to the first, and the velocity from specific forces alone, in its axes.

    Parameters
    ----------
    turn, push : (s, 3) as from :func:`increments`.
    quaternions : (s + 1, 4) first from present IMU axes, velocities : (s + 1, 3) m/s, out.
    """
    q = (1.0, 0.0, 0.0, 0.0)
    vx, vy, vz = 0.0, 0.0, 0.0
    quaternions[0, 0] = 1.0
    quaternions[0, 1:] = 0.0
    velocities[0] = 0.0
    for s in range(turn.shape[0]):
        a, b, c = turn[s, 0], turn[s, 1], turn[s, 2]
        x, y, z = push[s, 0], push[s, 1], push[s, 2]
        m = matrix(unit(product(q, exponential(0.5 * a, 0.5 * b, 0.5 * c))))
        vx += m[0] * x + m[1] * y + m[2] * z
        vy += m[3] * x + m[4] * y + m[5] * z
        vz += m[6] * x + m[7] * y + m[8] * z
        q = unit(product(q, exponential(a, b, c)))
        for j in range(4):
            quaternions[s + 1, j] = q[j]
        velocities[s + 1, 0], velocities[s + 1, 1], velocities[s + 1, 2] = vx, vy, vz
