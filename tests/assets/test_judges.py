"""Judges against the library that fitted them, and the files that are shipped."""

from __future__ import annotations

import json
from pathlib import Path

import lightgbm
import numpy as np
import pytest

from benchmarks.judgement import Segments, fit, written
from roadscan.assets.judgement import judge as judges
from roadscan.assets.judgement.judge import FOLDER, Judge, parsed
from roadscan.core.errors import RoadscanError


def streets(count: int) -> list[Segments]:
    """Segments whose truth follows from two of three features, one of which is not always known."""
    out = []
    for k in range(count):
        draw = np.random.default_rng(k)
        tall, wide, noise = draw.normal(size=(3, 120))
        true = tall + np.where(np.isnan(wide), 0.0, 0.5 * wide) + 0.3 * draw.normal(size=120) > 0.0
        wide[draw.random(120) < 0.2] = np.nan
        out.append(Segments(f"street {k}", "drawn", {"tall": tall, "wide": wide, "noise": noise}, true, np.ones(120)))
    return out


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(judges, "FOLDER", tmp_path)
    judges.model_of.cache_clear()
    return tmp_path


def test_a_judge_says_what_the_library_says_that_fitted_it(models: Path) -> None:
    train = streets(20)
    content = fit(train, increasing=["tall"])
    judge = Judge("drawn", written("drawn", content, models))
    rows = np.random.default_rng(9).normal(size=(500, 3))
    rows[::7, 1] = np.nan
    own = judge.probability(dict(zip(("tall", "wide", "noise"), rows.T, strict=True)))
    record = content["record"]
    held = [np.column_stack(list(one.features.values())) for one in train]
    data = lightgbm.Dataset(np.concatenate(held), np.concatenate([one.true for one in train]))
    sums = lightgbm.train(record["settings"], data, record["rounds"]).predict(rows, raw_score=True)
    theirs = 1.0 / (1.0 + np.exp(-(content["offset"] + content["slope"] * sums)))
    assert np.quantile(np.abs(own - theirs), 0.98) < 1e-4  # the file has six digits: a row may change sides
    more = judge.probability({"tall": rows[:, 0] + 0.5, "wide": rows[:, 1], "noise": rows[:, 2]})
    assert (more >= own).all()
    assert record["held out"]["drawn"]["recall"] > 0.85


def test_the_fit_is_the_same_each_time(models: Path) -> None:
    first, second = (written("drawn", fit(streets(6)), models) for _ in range(2))
    assert first == second


def test_another_file_is_refused(models: Path) -> None:
    digest = written("drawn", fit(streets(6)), models)
    (models / "drawn.json").write_text((models / "drawn.json").read_text().replace("tall", "wide", 1))
    with pytest.raises(RoadscanError, match=r"its file has the digest .* not " + digest):
        Judge("drawn", digest).probability({"tall": [0.0], "wide": [0.0], "noise": [0.0]})


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.json")), ids=lambda file: file.stem)
def test_each_file_tells_of_its_training(file: Path) -> None:
    model = parsed(json.loads(file.read_text()))
    assert model.features
    assert file.stat().st_size < 2_000_000
    assert model.record["held out"]
