"""What a head turns between a block's azimuth and a firing, measured in recordings of standing rigs.

Azimuths are right where walls are flat: k is the share of rate × firing time that has to be added to the azimuth of a
block for it. Manuals say 1 (`azimuth = "firing"`). ROS drivers add 0 for a Hesai, and for a VLP-32C, whose lasers they
count as fired one by one, 2.06 (`azimuth = "driver"`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.formats.lidars import hesai_packets
from tests.formats.readings import read

RATE = np.radians(3_600) * 1e-9  # 600 turns a minute (rad/ns)
DRIVERS_VLP_32C = 2 * 31 / 30  # (2.304 µs · 31) / (2.304 µs · (31 // 2))
FREE = Clock(TimeSystem.FREE, offset_s=1e9)

Points = np.ndarray


def cloud_of(recordings: Path, name: str) -> tuple[Points, Points]:
    """Returns with half of the turn (n, 3), and what the whole turn moves each (n, 3), less its mean."""
    folder = recordings / "lidars" / name
    if name.startswith("hesai"):
        title, file = {"hesai_40p": ("Pandar40P", "Pandar40P"), "hesai_xt32": ("PandarXT-32", "PandarXT32")}[name]
        log = read("hesai_scans", folder / "bag", {"angles": folder / f"{file}.csv"}, clock=FREE)
        fired_ns = np.array(next(m for m in hesai_packets.MODELS if m.name == title).firings_ns[0])
    else:
        log = read("velodyne_scans", folder / "bag", {"hour": "capture", "calibration": folder / "VLP32.yaml"})
        fired_ns = np.arange(32) // 2 * 2_304
    turn = (RATE * (fired_ns - fired_ns.mean()))[log["laser"]]
    x, y, z = log.xyz_sensor_m.T
    sine, cosine = np.sin(-turn / 2), np.cos(-turn / 2)
    points = np.stack([x * cosine + y * sine, y * cosine - x * sine, z], axis=1)
    return points, np.stack([points[:, 1], -points[:, 0], 0 * z], axis=1) * turn[:, None]


def walls(points: Points, cell_deg: float, cell_m: float, least_m: float, most_nz: float) -> Iterator[tuple[Any, ...]]:
    """Rows, middle and normal of the patches of plane walls (scatter below 2 cm)."""
    x, y, z = points.T
    level = np.hypot(x, y)
    near = np.flatnonzero((level > least_m) & (np.abs(z) < 3))
    cells = np.stack([np.arctan2(-y, x) / np.radians(cell_deg), z / cell_m, np.log(level) / 0.06])[:, near]
    _, cell, count = np.unique(np.floor(cells), axis=1, return_inverse=True, return_counts=True)
    order, ends = np.argsort(cell.ravel(), kind="stable"), np.cumsum(count)
    for end, size in zip(ends[count >= 60], count[count >= 60], strict=True):
        rows = near[order[end - size : end]]
        kept = np.ones(rows.size, dtype=bool)
        for _ in range(4):
            middle = points[rows[kept]].mean(axis=0)
            spread, axes = np.linalg.eigh(np.cov((points[rows[kept]] - middle).T))
            off = np.abs((points[rows] - middle) @ axes[:, 0])
            kept = off < 3.5 * (1.4826 * np.median(off[kept]) + 1e-4)
        if kept.sum() >= 60 and kept.mean() > 0.7 and spread[0] < 0.02**2 and spread[1] > 0.05**2:
            slant = abs(axes[:, 0] @ middle) / np.linalg.norm(middle)
            if abs(axes[2, 0]) < most_nz and 0.15 < slant < 0.95:
                yield rows[kept], middle, axes[:, 0]


def drawn(estimate: Callable[[np.ndarray], float], count: int) -> tuple[float, float]:
    """The estimate of all walls, and its σ by drawing walls with replacement."""
    rng = np.random.default_rng(0)
    return estimate(np.arange(count)), float(np.std([estimate(rng.integers(0, count, count)) for _ in range(400)]))


def flatness(recordings: Path, name: str) -> tuple[float, float]:
    """k and σ where firings are out of the order of elevations: it makes walls flat, whichever way they lean."""
    points, moved = cloud_of(recordings, name)
    sums = []
    for rows, middle, normal in walls(points, 2.0 if name == "velodyne_vlp32" else 3.0, 1.0, 1.0, 0.2):
        both = np.stack([moved[rows] @ normal, (points[rows] - middle) @ normal], axis=1)
        basis, _ = np.linalg.qr(np.column_stack([np.ones(rows.size), (points[rows] - middle) @ _along(normal)]))
        moves, off = (both - basis @ (basis.T @ both)).T
        sums.append(np.array([moves @ moves, moves @ off]) / (off @ off / rows.size))
    table = np.array(sums)
    assert len(table) >= 15
    return drawn(lambda i: 0.5 - table[i, 1].sum() / table[i, 0].sum(), len(table))


def _along(normal: np.ndarray) -> np.ndarray:
    return np.linalg.svd(normal[None])[2][1:].T


def plumbness(recordings: Path, name: str) -> tuple[float, float]:
    """k and σ where firings follow the elevations: it makes walls plumb, seen from their left and their right."""
    points, moved = cloud_of(recordings, name)
    rows_of = []
    for rows, middle, normal in walls(points, 4.0, 2.0, 0.8, np.sin(np.radians(3))):
        level = normal * [1, 1, 0] / np.hypot(normal[0], normal[1])
        at = points[rows] - middle
        if at[:, 2].std() < 0.08:
            continue
        plane = np.column_stack([np.ones(rows.size), at @ np.cross(level, [0, 0, 1]), at[:, 2]])
        lean, moves = (np.linalg.lstsq(plane, v @ level, rcond=None)[0][2] for v in (at, moved[rows]))
        rows_of.append((level[0], level[1], moves, lean))
    table = np.degrees(np.array(rows_of)) * [np.pi / 180, np.pi / 180, 1, 1]
    assert len(table) >= 25
    weight = np.ones(len(table))

    def estimate(i: np.ndarray) -> float:  # tilt of the sensor (two) and k: robust, as not all walls are plumb
        return float(0.5 - fit(i)[2])

    def fit(i: np.ndarray) -> np.ndarray:
        root = np.sqrt(weight[i])[:, None]
        return np.linalg.lstsq(table[i, :3] * root, table[i, 3] * root[:, 0], rcond=None)[0]

    everything = np.arange(len(table))
    for _ in range(50):
        off = table[:, 3] - table[:, :3] @ fit(everything)
        weight[:] = 1 / (1 + (off / (2 * 1.4826 * np.median(np.abs(off)))) ** 2) ** 2
    return drawn(estimate, len(table))


def test_the_turn_flattens_walls_of_a_pandar40p(recordings: Path) -> None:
    """0.84 ± 0.13: that of the manual, and not that of the drivers."""
    share, sigma = flatness(recordings, "hesai_40p")
    assert share > 4 * sigma
    assert abs(share - 1) < 2.5 * sigma


def test_walls_before_an_xt32_are_not_plumb_without_the_turn(recordings: Path) -> None:
    """3.1 ± 0.2: neither the manual's 1 nor the drivers' 0, as if the angle file were another unit's: no evidence."""
    share, sigma = plumbness(recordings, "hesai_xt32")
    assert share > 1 > 4 * sigma


def test_the_turn_of_the_drivers_roughens_walls_before_a_vlp_32c(recordings: Path) -> None:
    """0.6 ± 0.3: the manual's, or less, and not that of lasers that fire one by one."""
    share, sigma = flatness(recordings, "velodyne_vlp32")
    assert share + 3.5 * sigma < DRIVERS_VLP_32C
    assert abs(share - 1) < 3 * sigma
