"""``roadscan simulate`` and ``roadscan scenes``."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.model.errors import ConfigError
from roadscan.simulate import truth
from roadscan.simulate.scene import shipped_scenes

SCENE = """
length_m = 5.0
[profilers]
spacing_m = 0.5
readings = 50
[lidar]
on = false
[noise]
profiler_range_m = 0.001
"""


def test_a_scene_is_written_with_hits_and_another_seed(tmp_path: Path):
    scene, out = tmp_path / "scene.toml", tmp_path / "survey"
    scene.write_text(SCENE)
    command = ["simulate", str(scene), "--out", str(out)]
    done = CliRunner().invoke(app, [*command, "--hits", "--seed", "7"], catch_exceptions=False)
    assert done.exit_code == 0
    assert "22 profiles with 1,100 readings in all" in done.output
    known = truth.load(out)
    assert known.scene.seed == 7
    assert known.hits_file("run-1", "profiler_left").is_file()
    again = CliRunner().invoke(app, command)  # with the scene's own seed: another scene
    assert isinstance(again.exception, ConfigError)
    assert "another scene" in str(again.exception)


def test_the_scenes_are_listed():
    listed = CliRunner().invoke(app, ["scenes"], catch_exceptions=False).output
    assert all(name in listed for name in shipped_scenes())
