"""Faults in files of stores: none is silent. A few in each run of the tests, a thousand others each night."""

from __future__ import annotations

import datetime as dt
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import DamagedError, StoreError
from roadscan.inventory.inventory import Inventory
from tests.inventory.streets import Everywhere, file_of, found, inventory, poles
from tests.store_faults.base import prepare
from tests.store_faults.trial import FAULTS, Tree, damage, trials
from tests.surveys import Simulated

COUNT = 1_000
"""Trials of a night; ten nights draw ten thousand."""


@pytest.mark.nightly
@pytest.mark.timeout(10_800)
def test_no_fault_is_silent(tmp_path: Path) -> None:
    prepare(tmp_path / "base")
    seed = dt.date.today().toordinal()  # other faults each night
    drawn = list(trials(Tree(tmp_path / "base", tmp_path / "work"), COUNT, seed))
    bad = [f"seed {seed}: {one}" for one in drawn if one.is_bad]
    assert not bad, "\n".join(bad)
    states = Counter(one.state for one in drawn)
    assert states["named"] + states["refused"] > COUNT // 3, states  # the commands do rest on the files


def kept(folder: Path, publications: int = 2) -> Inventory:
    """An inventory with a commit of a run, one of a person, and publications."""
    street = inventory(folder, Everywhere())
    street.found = lambda: found(poles())
    for _ in range(publications):
        street.publish()
    return street


def read(street: Inventory) -> Any:
    """All that is read of an inventory's store: its commits, their rows, the rows that were published."""
    truth = street.truth
    truth.renew()
    mark = street.home.mark()
    assert mark is not None
    return (
        truth.commits,
        [truth.rows(c).to_pylist() for c in truth.commits if c.file],
        truth.published(mark.token),
        truth.faults(),
    )


@pytest.mark.slow
def test_no_fault_in_an_inventory_is_silent(tmp_path: Path) -> None:
    street = kept(tmp_path / "base")
    assert file_of(street).exists()
    tree = Tree(tmp_path / "base", tmp_path / "work")
    there = inventory(tmp_path / "work", Everywhere())
    clean = read(there)
    assert not clean[-1]
    files = sorted(name for name in tree.known if name.startswith("store/") and not name.endswith("lock"))
    assert {Path(name).parts[-2] for name in files} == {"asset_commits", "assets_found", "inventory", "published"}
    seen: Counter[str] = Counter()
    for number in range(120):
        random = np.random.default_rng([1, number])
        file, fault = files[number % len(files)], FAULTS[int(random.integers(4))]
        words = damage(tree, file, fault, random)
        try:
            answer = read(there)
        except StoreError as error:
            assert any(Path(name).name in str(error) for name in tree.changed()), (file, words, str(error))
            seen["named"] += 1
        else:
            told = any(Path(file).name in line for line in answer[-1])
            told |= answer[2] is None  # `inventory pull` refuses a home whose rows are gone
            if not told:
                assert answer[:-1] == clean[:-1], f"{file}: {words}: nothing tells"
                assert words == "deleted" or file.endswith("head.json"), f"{file}: {words}: nothing tells"
            seen["told" if told else "harmless"] += 1
        tree.restore()
    assert seen["named"] > 70


def test_the_last_commit_of_an_inventory_cannot_go_unseen(tmp_path: Path) -> None:
    street = kept(tmp_path)
    last = Path(street.truth.store.path(f"tables/asset_commits/{street.truth.commits[-1].number:08d}.parquet"))
    last.unlink()
    street.truth.renew()
    with pytest.raises(DamagedError, match=rf"{last.name}: commit {int(last.stem)} of the inventory is missing"):
        street.truth.commits  # noqa: B018 — reading is what is asked


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_verify_names_a_fault_in_a_store(finished: Simulated, tmp_path: Path, fault: str) -> None:
    tree = Tree(finished.survey_file.parent, tmp_path / "work")
    survey = str(tmp_path / "work" / finished.survey_file.name)
    own = f"store/survey={finished.store().survey_id}/"  # other tests keep stores beside it
    files = sorted(name for name in tree.known if name.startswith((f"{own}tiles/", f"{own}tables/", f"{own}products/")))
    for number in range(2):
        random = np.random.default_rng([2, number])
        file = files[int(random.integers(len(files)))]
        words = damage(tree, file, fault, random)
        result = CliRunner().invoke(app, ["verify", survey])
        assert result.exit_code == 1, f"{file}: {words}"
        assert Path(file).name in result.output, f"{file}: {words}: {result.output}"
        tree.restore()
