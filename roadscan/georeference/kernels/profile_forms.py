"""Map coordinates over the plane of a profile taken at one instant, as quadratic forms of its y and z."""

from __future__ import annotations

from roadscan.compute.kernel_options import inlined, kernel
from roadscan.georeference.kernels.charts import box_of, chart_index, expansion, map_value
from roadscan.poses.kernels.poses import attitude_at, interval, position_at

NO_FORMS = ((0.0,) * 6,) * 4
"""Forms that stand in where there is no pose."""


@inlined
def profile_form(c, ox, oy, oz, axis_y, axis_z):
    """Return a map coordinate over the profile's plane as (constant, y, z, y², y z, z²) coefficients.

    c : expansion of the coordinate; ox, oy, oz : sensor origin from the chart's centre (m);
    axis_y, axis_z : the sensor's y and z axes in the world (its x does not occur in a profile).
    """
    gx = c[1] + 2.0 * c[4] * ox + c[5] * oy + c[6] * oz
    gy = c[2] + c[5] * ox + 2.0 * c[7] * oy + c[8] * oz
    gz = c[3] + c[6] * ox + c[8] * oy + 2.0 * c[9] * oz
    ax, ay, az = axis_y
    bx, by, bz = axis_z
    return (
        map_value(c, ox, oy, oz),
        gx * ax + gy * ay + gz * az,
        gx * bx + gy * by + gz * bz,
        ax * (c[4] * ax + c[5] * ay + c[6] * az) + ay * (c[7] * ay + c[8] * az) + c[9] * az * az,
        2.0 * (c[4] * ax * bx + c[7] * ay * by + c[9] * az * bz)
        + c[5] * (ax * by + ay * bx) + c[6] * (ax * bz + az * bx) + c[8] * (ay * bz + az * by),
        bx * (c[4] * bx + c[5] * by + c[6] * bz) + by * (c[7] * by + c[8] * bz) + c[9] * bz * bz,
    )  # fmt: skip


@inlined
def form_value(f, y, z):
    """Return the value of :func:`profile_form` at sensor coordinates y, z (m)."""
    return f[0] + y * (f[1] + f[3] * y + f[4] * z) + z * (f[2] + f[5] * z)


@kernel
def profile_forms(epoch, k, georeference):
    """Return the map coordinates of a profile's plane at one epoch (GPS ns), in trajectory interval `k`.

    Returns
    -------
    placed : bool, False where there is no pose.
    forms : easting, northing, height as :func:`profile_form`; last, the body's height in the first place.
    """
    poses, charts = georeference.poses, georeference.charts
    if k < 0 or not poses.valid[k]:
        return False, NO_FORMS
    c = interval(poses.coefficients, k)
    u = (epoch - poses.knots[k]) / (poses.knots[k + 1] - poses.knots[k])
    px, py, pz = position_at(c, u)
    chart = chart_index(box_of(px, py, pz, charts.lattice), charts.lattice, charts.table, charts.centres_world_m)
    if chart < 0:
        return False, NO_FORMS
    r = attitude_at(c, u)
    px -= charts.centres_world_m[chart, 0]
    py -= charts.centres_world_m[chart, 1]
    pz -= charts.centres_world_m[chart, 2]
    b = georeference.mounting
    ox = px + (r[0] * b[9] + r[1] * b[10] + r[2] * b[11])
    oy = py + (r[3] * b[9] + r[4] * b[10] + r[5] * b[11])
    oz = pz + (r[6] * b[9] + r[7] * b[10] + r[8] * b[11])
    axis_y = (
        r[0] * b[1] + r[1] * b[4] + r[2] * b[7],
        r[3] * b[1] + r[4] * b[4] + r[5] * b[7],
        r[6] * b[1] + r[7] * b[4] + r[8] * b[7],
    )
    axis_z = (
        r[0] * b[2] + r[1] * b[5] + r[2] * b[8],
        r[3] * b[2] + r[4] * b[5] + r[5] * b[8],
        r[6] * b[2] + r[7] * b[5] + r[8] * b[8],
    )
    height_chart = expansion(charts.coefficients, chart, 2)
    return True, (
        profile_form(expansion(charts.coefficients, chart, 0), ox, oy, oz, axis_y, axis_z),
        profile_form(expansion(charts.coefficients, chart, 1), ox, oy, oz, axis_y, axis_z),
        profile_form(height_chart, ox, oy, oz, axis_y, axis_z),
        (map_value(height_chart, px, py, pz), 0.0, 0.0, 0.0, 0.0, 0.0),
    )
