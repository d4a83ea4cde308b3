"""What tells the sort of a stretch does not depend on the direction of its line, and tells a mesh from an opening."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest

from roadscan.assets.kinds.surfaces import parts_of
from roadscan.assets.upright.lines import COUNTS, PIECE_SCHEMA, STRETCHES, Chain, chains_of
from roadscan.assets.upright.sorts import features_of, probabilities_of

Float64 = npt.NDArray[np.float64]


def chain_of(count: int, **values: Float64) -> Chain:
    """A surface of 1.2 m of so many stretches of a metre, each with 160 sight lines that end on it."""
    usual = {
        "length_m": 1.0, "high_m": 101.2, "top_m": 101.2, "low_m": 100.1, "bulk_m": 100.25, "ground_m": 100.0,
        "returns": 300.0, "stopped": 160.0, "columns": 4.0,
    }  # fmt: skip
    stated = {name: np.full(count, usual.get(name, 0.0)) for name in STRETCHES} | values
    line = np.column_stack([np.concatenate([[0.0], np.cumsum(stated["length_m"])]), np.zeros(count + 1)])
    return Chain(line, stated, 0.02, (count / 2, 6.0), 300 * count, frozenset({1}), (0, 1))


def test_a_line_that_is_read_backwards_tells_the_same() -> None:
    rng = np.random.default_rng(3)
    n = 30
    lines = rng.integers(0, 200, n).astype(float)
    values = {
        "length_m": rng.uniform(0.2, 1.3, n), "high_m": 101.2 + rng.normal(0.0, 0.2, n), "passed": lines,
        "leaves": rng.uniform(0.0, 300.0, n), "under": lines / 4, "foot": lines / 9,
        "open_columns": rng.integers(0, 5, n).astype(float),
    }  # fmt: skip
    values["high_m"][[4, 17]] = np.nan  # gaps
    there = features_of(chain_of(n, **values))
    back = features_of(chain_of(n, **{name: value[::-1] for name, value in values.items()}))
    for name, value in there.items():
        np.testing.assert_allclose(value, back[name][::-1], rtol=1e-12, atol=1e-12, err_msg=name)


def test_as_many_lines_go_through_a_mesh_everywhere_and_through_an_opening_at_one_place() -> None:
    n, share = 20, 0.2
    passed = np.full(n, 200.0 * share)
    # lines pass a mesh in all columns, as 50 of them met each; an opening of 0.25 m is one of four
    told = [
        features_of(chain_of(n, passed=passed, stopped=200.0 - passed, open_columns=np.full(n, opened)))["evenly_8"]
        for opened in (4.0, 1.0)
    ]
    np.testing.assert_allclose(told[0], 1.0, atol=0.01)
    np.testing.assert_allclose(told[1], 0.25, atol=0.01)


def test_a_place_without_returns_is_of_any_sort() -> None:
    high = np.full(9, 101.2)
    high[4] = np.nan
    told = probabilities_of(chain_of(9, high_m=high))
    np.testing.assert_allclose(told.sum(axis=1), 1.0)
    np.testing.assert_allclose(told[4], 0.25)
    assert (told[3] != 0.25).all()


def test_stretches_that_are_higher_or_lower_are_of_something_else() -> None:
    """A wall of 3 m that lets nothing through, and beside it a mesh of 1.2 m: each is told by its own lines."""
    passed = np.repeat([0.0, 100.0], 10)
    high = np.repeat([103.0, 101.2], 10)
    told = features_of(chain_of(20, passed=passed, high_m=high))
    np.testing.assert_allclose(told["passing_8"], np.repeat([0.0, 100.0 / 260.0], 10))
    np.testing.assert_allclose(told["highest_m"][[0, 10, 19]], [3.0, 3.0, 1.2])


@pytest.mark.parametrize(
    ("top_m", "long_m", "is_one"),
    [(np.nan, 3.0, True), (2.7, 1.0, True), (2.7, 3.0, True), (1.0, 3.0, False)],
)
def test_a_front_goes_on_behind_what_hides_a_part_of_it(top_m: float, long_m: float, is_one: bool) -> None:
    """Six metres of a front of 6 m, some that are not seen, or only up to a height, and six more."""
    n = round(long_m)
    high = 100.0 + np.concatenate([np.full(6, 6.0), np.full(n, top_m), np.full(6, 6.0)])
    told = parts_of(chain_of(12 + n, high_m=high, top_m=high))
    assert (told == [("facade", 0, 12 + n)]) == is_one


@pytest.mark.parametrize("shares", [(0.05,), (0.5,), (0.9,), (0.3, 0.7), (0.2, 0.4, 0.9)])
def test_a_stretch_that_borders_of_squares_cut_is_one(shares: tuple[float, ...]) -> None:
    rng = np.random.default_rng(5)
    whole = chain_of(9, passed=rng.integers(0, 30, 9).astype(float), open_columns=np.full(9, 3.0))
    pieces = []
    for first, last in itertools.pairwise((0.0, *(4.0 + share for share in shares), 9.0)):
        numbers = np.arange(int(first), int(np.ceil(last)))
        ends = np.array([first, *numbers[1:].tolist(), last])
        values = {name: value[numbers] for name, value in whole.values.items()}
        values |= {name: values[name] * np.diff(ends) for name in (*COUNTS, "length_m")}
        pieces.append({
            "x_m": ends, "y_m": np.zeros(ends.size), **values, "across_m": 0.02, "sensor_x_m": 4.5, "sensor_y_m": 6.0,
            "seen": 9, "passes": [1], "first_epoch_gps_ns": 0, "last_epoch_gps_ns": 1,
        })  # fmt: skip
    (joined,) = chains_of(pa.Table.from_pylist(pieces, schema=PIECE_SCHEMA))
    np.testing.assert_allclose(joined.xy_m, whole.xy_m)
    for name, value in whole.values.items():
        np.testing.assert_allclose(joined.values[name], value, err_msg=name)
