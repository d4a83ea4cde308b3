"""Packages that come with an extra: what is missing is one sentence, and everything else works."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.testing import CliRunner

from roadscan.calibrate.tasks.calibrate import calibrate_survey
from roadscan.cli import app
from roadscan.core.errors import ConfigError
from roadscan.core.extras import EXTRAS, _Late, need, needed
from roadscan.core.survey import Survey
from roadscan.demo.demo import prepare_demo
from roadscan.formats.cameras.video import look_into
from roadscan.inventory.homes.postgis import PostGis
from roadscan.run.engine.compute_on import embedded
from roadscan.simulate import Scene, simulate
from roadscan.store.store import Store
from tests.conftest import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
BLOCKED = f"""
import importlib.abc, sys
class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in {sorted(EXTRAS)}:
            raise ModuleNotFoundError("No module named " + name, name=name)
sys.meta_path.insert(0, Blocked())
"""
IMPORT_ALL = """
import importlib, pkgutil, roadscan
for found in pkgutil.walk_packages(roadscan.__path__, "roadscan."):
    if not found.name.endswith("__main__"):
        importlib.import_module(found.name)
"""


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """None of them can be imported."""
    for module in EXTRAS:
        monkeypatch.setitem(sys.modules, module, None)
    return monkeypatch


@pytest.mark.parametrize("module", EXTRAS)
def test_a_missing_package_is_one_sentence(module: str, without: pytest.MonkeyPatch) -> None:
    distribution, extra = EXTRAS[module]
    sentence = f'this needs the package {distribution}; pip install "roadscan[{extra}]"'
    for asked in (need, needed):
        with pytest.raises(ConfigError) as caught:
            asked(module, "this")
        assert str(caught.value) == sentence
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        _Late(module, "this").anything()


@pytest.mark.parametrize("module", EXTRAS)
def test_the_extra_that_is_named_brings_the_package(module: str) -> None:
    distribution, extra = EXTRAS[module]
    brought = PROJECT["optional-dependencies"][extra]
    assert canonicalize_name(distribution) in {canonicalize_name(Requirement(one).name) for one in brought}


def test_all_has_every_extra() -> None:
    (everything,) = (Requirement(one) for one in PROJECT["optional-dependencies"]["all"])
    assert everything.name == PROJECT["name"]
    assert everything.extras == PROJECT["optional-dependencies"].keys() - {"all", "dev"}


def test_the_readme_lists_every_extra_and_first_those_that_make_installs() -> None:
    table = (REPOSITORY / "README.md").read_text(encoding="utf-8").split("| extra |")[1].split("\n\n")[0]
    listed = [name for row in table.splitlines()[2:] for name in re.findall(r"`([a-z0-9]+)`", row.split("|")[1])]
    assert set(listed) == PROJECT["optional-dependencies"].keys() - {"dev"}
    installed = re.findall(r"install_into_venv,\.\[(.*)\]\)", (REPOSITORY / "Makefile").read_text(encoding="utf-8"))[0]
    assert set(listed[:5]) == set(installed.split("$(comma)"))


@pytest.mark.slow
def test_every_module_can_be_imported_without_extras() -> None:
    outcome = subprocess.run(
        [sys.executable, "-c", BLOCKED + IMPORT_ALL], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert outcome.returncode == 0, outcome.stderr


def test_what_asks_for_one_says_so_before_it_begins(without: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opencv = r'needs the package opencv-python-headless; pip install "roadscan\[opencv\]"$'
    with pytest.raises(ConfigError, match=f"^a simulated camera {opencv}"):
        simulate(Scene(id="street", length_m=20.0, camera={"on": True}), tmp_path / "street")
    assert not (tmp_path / "street").exists()
    with pytest.raises(ConfigError, match=f"^the demo {opencv}"):
        prepare_demo(tmp_path / "demo", print)
    assert not (tmp_path / "demo").exists()
    with pytest.raises(ConfigError, match=f"^a video {opencv}"):
        look_into(tmp_path / "front.mp4")
    with pytest.raises(ConfigError, match=r'^a home in PostGIS .* "roadscan\[postgis\]"$'):
        PostGis("postgresql://somebody@nowhere/nothing")
    with pytest.raises(ConfigError, match=r'^the store s3://bucket/survey .* "roadscan\[s3\]"$'):
        Store("s3://bucket/survey", "street")
    with pytest.raises(ConfigError, match=r'^--dashboard .* "roadscan\[dashboard\]"$'), embedded(1, print):
        pass


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Survey file of twenty metres of road with two profilers."""
    scene = Scene(id="street", length_m=20.0, lidar={"on": False}, profilers={"spacing_m": 0.1, "readings": 200})
    return simulate(scene, tmp_path_factory.mktemp("extras") / "street").survey_file


@pytest.mark.slow
def test_a_run_without_extras_makes_all_but_pictures_of_figures(street: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = street.parent / "store" / "survey=street" / "products" / "adjustment" / "adjustment.png"
    command = ["run", str(street), "--workers", "0"]
    with pytest.MonkeyPatch.context() as blocked:
        for module in EXTRAS:
            blocked.setitem(sys.modules, module, None)
        first = CliRunner().invoke(app, command)
        assert first.exit_code == 0, first.output
        assert first.output.count('pictures of figures are not drawn: pip install "roadscan[pictures]"') == 1
        assert list(picture.parents[1].glob("mosaic/*.tif"))
        assert (picture.parents[2] / "report" / "report.html").is_file()
        assert not picture.exists()
        assert "adjust: solution settled" in first.output
        assert "adjust: solution settled" not in CliRunner().invoke(app, command).output
    again = CliRunner().invoke(app, command)
    assert again.exit_code == 0, again.output
    assert "are not drawn" not in again.output
    assert picture.is_file()


SETTINGS = {"[surface]": 'method = "cells"\nsigma_m = 0.001\n'}


@pytest.mark.parametrize("section", ["[surface]", "[assets]", "[condition.roughness_regions]"])
def test_a_section_that_needs_opencv_is_refused_before_the_run(
    section: str, street: Path, without: pytest.MonkeyPatch
) -> None:
    survey_file = street.with_name("WITH.toml")
    survey_file.write_text(
        street.read_text().replace('store = "', 'store = "other-') + f"\n{section}\n{SETTINGS.get(section, '')}"
    )
    outcome = CliRunner().invoke(app, ["run", str(survey_file), "--workers", "0"])
    needs = 'needs the package opencv-python-headless; pip install "roadscan[opencv]"'
    assert str(outcome.exception) == f"the section {section} {needs}"
    assert not (street.parent / "other-store").exists()


def test_a_calibration_against_a_scan_needs_the_icp(street: Path, without: pytest.MonkeyPatch) -> None:
    survey = Survey.load(street)
    values = survey.config.model_dump() | {
        "rig": survey.rig.model_dump(),
        "calibration": [
            {
                "kind": "reference",
                "sensor": "profiler_left",
                "path": "scan.las",
                "crs": "EPSG:4979",
                "height": "ellipsoidal",
            }
        ],
    }
    asking = Survey.parse(values, folder=survey.folder)
    with pytest.raises(ConfigError, match=r'needs the package small_gicp; pip install "roadscan\[icp\]"$'):
        calibrate_survey(asking, Store(asking.store_url, asking.config.id))
