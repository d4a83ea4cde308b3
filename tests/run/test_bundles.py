"""Bundles: the same files whatever goes together, and nothing lost that was finished."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roadscan.core.errors import StoreError
from roadscan.core.survey import Survey
from roadscan.footprints import footprints
from roadscan.footprints.footprints import PRODUCT, index_footprints
from roadscan.georeference.plan.plan import plan_survey
from roadscan.run.engine.compute import Done, Inline, cut_bundles, run_bundles
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store
from roadscan.tiles.mosaics import products
from roadscan.tiles.mosaics.products import make_products, plan_outputs
from tests.surveys import Simulated


def made(store: Store) -> dict[str, bytes]:
    """Footprints and files of survey products; pictures of the adjustment are its stage's."""
    paths = [p for top in ("tables/footprints", "products") for p in store.files(top)]
    return {p: store.read_bytes(p) for p in paths if not p.startswith("products/adjustment/")}


@pytest.fixture
def emptied(finished: Simulated, tmp_path: Path) -> Store:
    """A finished store without its footprints and survey products."""
    whole = finished.store()
    shutil.copytree(
        whole.root, tmp_path / Path(whole.root).name, ignore=shutil.ignore_patterns("footprints", "products")
    )
    store = Store(str(tmp_path), whole.survey_id)
    manifest = Manifest(store)
    kinds = {PRODUCT, *(r.product for r in manifest.all() if r.path.startswith("products/"))}
    manifest.remove([r for r in manifest.all() if r.product in kinds])
    assert not made(store)
    return store


@pytest.mark.parametrize("most", [1, 1 << 40])
def test_same_bytes_whatever_goes_together(
    finished: Simulated, emptied: Store, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each file a task, or as much as four a worker allow; `finished` was made with the usual size."""
    monkeypatch.setattr(footprints, "_ROW_GROUPS", most)
    monkeypatch.setattr(products, "_TILES_DRAWN", most)
    plan, counted = plan_survey(Survey.load(finished.survey_file), emptied), Counted()
    shown: list[tuple[int, int]] = []
    assert not index_footprints(plan, Manifest(emptied), counted, lambda *told: shown.append(told))
    files = len(plan.slices())
    assert shown[0] == (0, files)
    assert shown[-1] == (files, files)
    assert counted.tasks == files if most == 1 else counted.tasks <= 4
    assert not make_products(plan, Manifest(emptied), counted)
    assert made(emptied) == made(finished.store())


def test_killed_between_bundles_goes_on_there(finished: Simulated, emptied: Store) -> None:
    plan = plan_survey(Survey.load(finished.survey_file), emptied)
    with pytest.raises(KeyboardInterrupt):
        index_footprints(plan, Manifest(emptied), Counted(stop_after=2))
    kept = set(Manifest(emptied).of(PRODUCT))
    assert 2 <= len(kept) < len(plan.slices())
    shown: list[tuple[int, int]] = []
    assert not index_footprints(plan, Manifest(emptied), Inline(), lambda *told: shown.append(told))
    assert shown[0] == (0, len(plan.slices()) - len(kept))
    stale, _ = plan_outputs(plan, Manifest(emptied))
    with pytest.raises(KeyboardInterrupt):
        make_products(plan, Manifest(emptied), Counted(stop_after=1))
    left, _ = plan_outputs(plan, Manifest(emptied))
    assert 0 < len(left) < len(stale)
    assert not make_products(plan, Manifest(emptied), Inline())
    assert made(emptied) == made(finished.store())


def test_a_damaged_file_costs_itself_and_is_named(finished: Simulated, emptied: Store) -> None:
    plan = plan_survey(Survey.load(finished.survey_file), emptied)
    bad = plan.slices()[1].file
    emptied.write_bytes(bad, b"no Parquet")
    ((file, reason),) = index_footprints(plan, Manifest(emptied), Inline())
    assert file == bad
    assert bad in reason
    assert set(Manifest(emptied).of(PRODUCT)) == {s.file for s in plan.slices()} - {bad}


class Counted(Inline):
    """Counts tasks; the process is killed after some of them, if that is asked for."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.tasks, self.stop_after = 0, stop_after

    def map(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Done[Any, Any]]:
        for done in super().map(function, tasks):
            if self.tasks == self.stop_after:
                raise KeyboardInterrupt
            self.tasks += 1
            yield done


class DyingWorkers(Inline):
    """Workers that die of every task of more than one piece."""

    def map(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[Done[Any, Any]]:
        for task in tasks:
            yield (
                Done(task, None, MemoryError("worker")) if len(task.pieces) > 1 else next(super().map(function, [task]))
            )


def doubled(number: int) -> OutputRecord:
    """Fails for multiples of five."""
    if number % 10 == 0:
        raise StoreError(f"{number} is damaged", file="log.bin")
    if number % 5 == 0:
        raise ValueError(f"{number}")
    return OutputRecord("doubled", str(number), str(2 * number), "", 0, "")


@pytest.mark.parametrize("compute", [Inline(), DyingWorkers()])
def test_each_piece_ends_by_itself(compute: Inline, tmp_path: Path) -> None:
    manifest, shown = Manifest(Store(str(tmp_path), "s")), []
    pieces = list(range(1, 24))
    failures = run_bundles(doubled, pieces, lambda _: 1, 7, manifest, compute, lambda *told: shown.append(told))
    assert sorted(n for n, _ in failures) == [5, 10, 15, 20]
    assert all(
        ("ValueError: " in why) if n % 10 else f"{n} is damaged" in why and "log.bin" in why for n, why in failures
    )
    again = {int(unit): int(r.key) for unit, r in Manifest(Store(str(tmp_path), "s")).of("doubled").items()}
    assert again == {n: 2 * n for n in pieces if n % 5}
    assert [done for done, _ in shown] == sorted(done for done, _ in shown)
    assert shown[-1] == (23, 23)


def test_bundles_are_full_and_none_is_too_large() -> None:
    random = np.random.default_rng(5)
    for _ in range(50):
        work = random.integers(1, 100, random.integers(1, 60)).tolist()
        most, workers = float(random.integers(1, 500)), int(random.integers(1, 5))
        bundles = cut_bundles(work, most, workers)
        assert [n for b in bundles for n in b] == list(range(len(work)))
        limit = min(most, sum(work) / (4 * workers))
        sums = [sum(work[n] for n in b) for b in bundles]
        assert all(s <= limit or len(b) == 1 for s, b in zip(sums, bundles, strict=True))
        assert all(s + work[later[0]] > limit for s, later in zip(sums, bundles[1:], strict=False))
    assert cut_bundles([], 10, 2) == []
    assert list(itertools.chain(*cut_bundles([0, 0], 10, 1))) == [0, 1]
