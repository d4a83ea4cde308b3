"""``roadscan simulate`` and ``roadscan scenes``."""

from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from roadscan.cli import app
from roadscan.core.errors import ConfigError, FormatError
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


def test_an_edited_survey_file_is_not_overwritten(tmp_path: Path):
    scene, out = tmp_path / "scene.toml", tmp_path / "survey"
    scene.write_text(SCENE)
    command = ["simulate", str(scene), "--out", str(out)]
    for _ in range(2):  # once more as it is: the same bytes
        assert CliRunner().invoke(app, command, catch_exceptions=False).exit_code == 0
    for name in ("SURVEY.toml", "RIG.toml", "control.csv"):
        file = out / name
        written = file.read_text()
        edited = written + "# mine\n"
        file.write_text(edited)
        refused = CliRunner().invoke(app, command)
        assert isinstance(refused.exception, ConfigError)
        assert name in str(refused.exception)
        assert "--force" in str(refused.exception)
        assert file.read_text() == edited
        CliRunner().invoke(app, [*command, "--force"], catch_exceptions=False)
        assert file.read_text() == written


def test_the_demo_does_not_run_somebody_elses_survey(tmp_path: Path):
    survey = tmp_path / "SURVEY.toml"
    survey.write_text("id = 'mine'\n")
    done = CliRunner().invoke(app, ["demo", "--out", str(tmp_path)])
    assert isinstance(done.exception, FormatError)
    assert list(tmp_path.iterdir()) == [survey]
