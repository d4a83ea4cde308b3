"""The page docs/simulator.md: its examples run, and it names every field of a scene."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from roadscan.core.strict import load_toml
from roadscan.simulate import Scene
from roadscan.simulate.scene import shipped_scenes

DOCS = Path(__file__).resolve().parents[2] / "docs"


def models(annotation: Any) -> set[type[BaseModel]]:
    """Models inside an annotation, and inside their fields."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        inner = [models(info.annotation) for info in annotation.model_fields.values()]
        return {annotation}.union(*inner)
    return set().union(*(models(argument) for argument in get_args(annotation)))


def test_the_page_has_a_table_for_every_part_of_a_scene():
    template = (DOCS / "pages" / "simulator.md").read_text()
    missing = [kind.__name__ for kind in models(Scene) if f"{kind.__module__}:{kind.__name__}}}}}" not in template]
    assert missing == ["Scene"] or missing == []
    assert "{{fields roadscan.simulate.scene:Scene}}" in template


def test_the_page_shows_every_scene():
    page = (DOCS / "simulator.md").read_text()
    for name in shipped_scenes():
        for what in ("plan", "views", "sensors"):
            assert f"pictures/simulator-{name}-{what}.jpg" in page
            assert 1_000 < (DOCS / "pictures" / f"simulator-{name}-{what}.jpg").stat().st_size < 200_000


def test_the_short_scene_is_one():
    file = DOCS / "examples" / "scene.toml"
    assert Scene.parse(load_toml(file), file=file).id == "my-street"


@pytest.mark.slow
def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(DOCS / "examples" / "simulate_scene.py"))
    runpy.run_path(str(DOCS / "examples" / "ask_truth.py"))
    shown = capsys.readouterr().out
    assert "['000000.jpg', '000001.jpg']" in shown
    assert "returns of road 0" in shown
