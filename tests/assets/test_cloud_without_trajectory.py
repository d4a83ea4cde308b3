"""A cloud of which nothing tells from where it was seen: posts keep their places, and σ says what is not known."""

from pathlib import Path

import geopandas
import numpy as np
import pytest

from tests.assets.isprs_run import CORNER_M, run_cloud

_POSTS = ((8.0, 6.0, 0.06), (14.0, 13.0, 0.10), (21.0, 5.0, 0.15))
"""Place and radius of the posts of the cloud (m)."""


def cloud(rng: np.random.Generator) -> np.ndarray:
    """Ground and posts 3.6 m high, of each the half that a scanner at (12, −4) would see; noise of 8 mm."""
    ground = np.column_stack([rng.uniform(0.0, 28.0, 60_000), rng.uniform(0.0, 18.0, 60_000), np.zeros(60_000)])
    parts = [ground]
    for x, y, radius in _POSTS:
        ring = np.repeat(np.arange(0.05, 3.6, 0.06), 14)
        turn = np.arctan2(-4.0 - y, 12.0 - x) + np.arcsin(rng.uniform(-1.0, 1.0, ring.size))
        parts.append(np.column_stack([x + radius * np.cos(turn), y + radius * np.sin(turn), ring]))
    points = np.concatenate(parts)
    return points + rng.normal(0.0, 0.008, points.shape)


@pytest.mark.slow
def test_posts_of_a_cloud_without_a_trajectory(tmp_path: Path) -> None:
    run_cloud(cloud(np.random.default_rng(20261127)), tmp_path, "[assets]\n")
    files = list(tmp_path.rglob("products/assets/poles.parquet"))
    found = geopandas.read_parquet(files[0])
    assert len(found) == len(_POSTS)
    for x, y, radius in _POSTS:
        away = np.hypot(found.geometry.x - CORNER_M[0] - x, found.geometry.y - CORNER_M[1] - y)
        post = found.loc[away.idxmin()]
        assert away.min() < 0.03
        assert away.min() < 2.5 * post["sigma_horizontal_m"]
        assert abs(post["diameter_m"] - 2.0 * radius) < 2.5 * post["sigma_size_m"] < 0.2
