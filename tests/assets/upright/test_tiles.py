"""Objects do not depend on the tiles that their pieces were found in."""

from __future__ import annotations

import functools

import numpy as np
import pyarrow as pa
import pytest

from roadscan.assets.kind import AssetObject, asset_kinds
from roadscan.assets.kinds.surfaces import parts_of
from roadscan.assets.make_scene import lines_beyond
from roadscan.assets.scene import Box, Scene
from roadscan.assets.upright.lines import PIECE_SCHEMA, STRETCHES, Chain, chains_of
from roadscan.assets.upright.standing import candidates_of, features_of
from tests.assets.upright.scene import objects_of, simulated

TILE_M, HALO_M = 20.0, 8.0


@functools.cache
def tiles() -> list[Scene]:
    """The simulated scene as tiles of 20 m with halos of 8 m."""
    whole, _ = simulated()
    out = []
    for x in np.arange(whole.tile.x_min_m, whole.tile.x_max_m, TILE_M).tolist():
        for y in np.arange(whole.tile.y_min_m, whole.tile.y_max_m, TILE_M).tolist():
            window = Box(x - HALO_M, y - HALO_M, x + TILE_M + HALO_M, y + TILE_M + HALO_M)
            inside = window.holds(whole.returns.x_m, whole.returns.y_m)
            if inside.any():
                scene = Scene(
                    whole.returns.at(inside), Box(x, y, x + TILE_M, y + TILE_M), window, whole.ground,
                    whole.above_ground_m[inside], whole.classes[inside], whole.drive_xyh_m,
                    beyond_m=lines_beyond(whole.returns, window),
                )  # fmt: skip
                out.append(scene)
    return out


def joined(kind: str, scenes: list[Scene] | None = None) -> list[AssetObject]:
    """Objects of a kind from the pieces of all tiles."""
    one = asset_kinds()[kind]
    pieces = pa.concat_tables([one.evidence(scene, one.options()).pieces for scene in scenes or tiles()])
    return list(one.objects(pieces, one.options(), {}))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pole", "lighting", "tree", "delineator", "sign", "clearance"])
def test_points_are_found_once_at_the_same_place(kind: str) -> None:
    scene, _ = simulated()
    whole, parts = objects_of(scene, kind), joined(kind)
    assert len(parts) == len(whole) > 0
    for one in whole:
        assert min(one.geometry.distance(other.geometry) for other in parts) < 0.02


@pytest.mark.parametrize("kind", ["pole", "lighting", "tree", "delineator", "sign", "clearance"])
def test_tiles_of_one_scene_hold_what_it_holds(kind: str) -> None:
    scene, _ = simulated()
    parts, whole = joined(kind, [scene.of_tile(one.tile) for one in tiles()]), objects_of(scene, kind)
    assert len(whole) > 0
    assert [(one.geometry.wkb, one.attributes) for one in parts] == [(o.geometry.wkb, o.attributes) for o in whole]


def test_as_many_sight_lines_meet_a_shaft_however_tiles_are_cut() -> None:
    whole, _ = simulated()
    names = ("goes_through", "open_more", "open_less", "open_both")

    def told(scene: Scene) -> dict[tuple[float, ...], list[float]]:
        shafts = candidates_of(scene)
        features = features_of(scene, shafts)
        return {
            (*np.round(s.foot_xy_m, 4).tolist(), float(s.slices)): [round(float(features[n][k]), 9) for n in names]
            for k, s in enumerate(shafts)
            if scene.tile.holds(*s.foot_xy_m)
        }

    every = told(whole)
    parts = {place: values for scene in tiles() for place, values in told(scene).items()}
    same = [place for place in parts if place in every]
    assert len(same) > 0.9 * len(every) > 10
    assert str([parts[place] for place in same]) == str([every[place] for place in same])
    assert np.isfinite([every[place] for place in same]).mean() > 0.5


@pytest.mark.parametrize("kind", ["guardrail", "fence", "wall", "facade"])
def test_lines_go_on_across_borders(kind: str) -> None:
    scene, _ = simulated()
    whole, parts = objects_of(scene, kind), joined(kind)
    assert len(parts) == len(whole) > 0
    for one, other in zip(
        *(sorted(objects, key=lambda o: o.attributes["length_m"]) for objects in (whole, parts)), strict=True
    ):
        assert abs(one.attributes["length_m"] - other.attributes["length_m"]) < 0.02 * one.attributes["length_m"] + 0.3
        assert abs(one.attributes["asset_height_m"] - other.attributes["asset_height_m"]) < 0.1


def test_a_chain_is_the_same_whatever_order_its_pieces_come_in() -> None:
    one = asset_kinds()["fence"]
    parts = [one.evidence(scene, one.options()).pieces for scene in tiles()]
    first = chains_of(pa.concat_tables(parts))
    second = chains_of(
        pa.concat_tables([p.take(pa.array(range(p.num_rows - 1, -1, -1), pa.int64())) for p in parts[::-1]])
    )
    assert first[0].xy_m.shape == second[0].xy_m.shape
    for a, b in zip(first, second, strict=True):
        assert (a.xy_m == b.xy_m).all() and all(
            (a.values[n] == b.values[n])[~np.isnan(a.values[n])].all() for n in a.values
        )
    assert chains_of(PIECE_SCHEMA.empty_table()) == []


def test_a_chain_was_seen_by_the_passes_of_all_its_pieces() -> None:
    """Two pieces of a fence end to end: one seen by passes 1 and 2, the next by 2 and 3."""

    def piece(start_m: float, passes: list[int]) -> dict[str, object]:
        values = {name: [0.0] for name in STRETCHES} | {"high_m": [1.5], "length_m": [5.0]}
        return {
            "x_m": [start_m, start_m + 5.0], "y_m": [0.0, 0.0], **values, "across_m": 0.01,
            "sensor_x_m": 0.0, "sensor_y_m": 9.0, "seen": 100, "passes": passes,
            "first_epoch_gps_ns": passes[0], "last_epoch_gps_ns": passes[-1],
        }  # fmt: skip

    (chain,) = chains_of(pa.Table.from_pylist([piece(0.0, [1, 2]), piece(5.0, [2, 3])], schema=PIECE_SCHEMA))
    assert (len(chain.passes), chain.seen, chain.epochs_gps_ns) == (3, 200, (1, 3))


@pytest.mark.parametrize(("passed", "name"), [(20.0, "fence"), (0.0, "barrier")])
def test_a_house_and_what_goes_on_in_its_line_are_two_things(passed: float, name: str) -> None:
    """Eight metres of a house of 6 m, then four metres of 1.1 m that let half of the sight lines pass, or none."""
    house, low = np.full(8, 1.0), np.full(4, 1.0)
    values = {
        "ground_m": np.zeros(12), "low_m": np.full(12, 0.1), "bulk_m": np.full(12, 0.2), "length_m": np.ones(12),
        "high_m": np.concatenate([6.0 * house, 1.1 * low]), "returns": np.full(12, 50.0), "stopped": np.full(12, 20.0),
        "passed": np.concatenate([0.0 * house, passed * low]), "under": np.zeros(12), "open_top": np.zeros(12),
        "leaves": np.zeros(12), "columns": np.full(12, 2.0), "foot": np.zeros(12),
        "open_columns": np.concatenate([0.0 * house, (2.0 if passed else 0.0) * low]),
    }  # fmt: skip
    values["top_m"] = values["high_m"]
    line = np.column_stack([np.arange(13.0), np.zeros(13)])
    chain = Chain(line, values, 0.02, (0.0, 9.0), 600, frozenset({1}), (0, 1))
    assert parts_of(chain) == [("facade", 0, 8), (name, 8, 12)]
