"""Edits of roadscan's own code: what shapes an output makes it stale, and nothing else does."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import roadscan
from roadscan.store.manifest import Manifest
from roadscan.tiles.tasks.tile_plan import TILE
from tests.surveys import Simulated

PRODUCT = '''
from roadscan.tiles.product import TileProduct


class Another(TileProduct):
    """Another product."""

    name = "another"
    title = "another"
    suffix = ".txt"
    default = False
'''
FORMAT = '''
from roadscan.ingest.reading.format import LogFormat


class Another(LogFormat):
    """Another format."""

    name = "another"
    title = "another"
    yields = ("returns",)
    time = "its own"

    def sniff(self, path):
        return False
'''
LOOK = """
import sys
from roadscan.run.session import Session
from roadscan.survey.status import survey_status

found = survey_status(Session.open(sys.argv[1]))
stale = [found.of(stage).stale for stage in ("footprints", "tiles", "products")]
print(*stale, found.is_complete)
"""


def tiles_of(finished: Simulated) -> int:
    """Tiles that a reading may touch, all of which are current."""
    return len(Manifest(finished.store()).of(TILE))


@pytest.fixture
def edited(tmp_path: Path, finished: Simulated) -> Callable[..., tuple[int, int, int, bool]]:
    """What another state of the code says of the finished survey: stale footprints, tiles, products; complete."""
    package = Path(roadscan.__file__).parent
    shutil.copytree(package, tmp_path / "roadscan")  # with what Python has compiled, which still fits the copies
    shutil.copytree(package.parent / "schemas", tmp_path / "schemas")

    def status(*changes: tuple[str, str, str]) -> tuple[int, int, int, bool]:
        """`changes`: file, what is replaced (a regular expression), by what; or the text of a new file."""
        for name, old, new in changes:
            file = tmp_path / "roadscan" / name
            text, count = re.subn(old, new, file.read_text(), count=1) if old else (new, 1)
            assert count == 1, f"{name} has no {old}"
            file.write_text(text)
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        asked = [sys.executable, "-c", LOOK, str(finished.survey_file)]
        told = subprocess.run(asked, env=environment, cwd=tmp_path, check=True, capture_output=True, text=True)
        footprints, tiles, products, complete = told.stdout.split()
        return int(footprints), int(tiles), int(products), complete == "True"

    return status


@pytest.mark.slow
def test_what_is_added_leaves_every_output_current(edited: Callable[..., tuple[int, int, int, bool]]) -> None:
    kernel = "from roadscan.compute.kernel_options import kernel\n\n\n@kernel\ndef another(x):\n    return x\n"
    assert edited(
        ("tiles/kernels/another.py", "", kernel),
        ("tiles/products/another.py", "", PRODUCT),
        ("formats/another.py", "", FORMAT),
        ("ingest/inspect/inspect.py", r"\Z", "\nANOTHER = 1\n"),
        ("core/errors.py", r"\Z", "\n\nclass AnotherError(RoadscanError):\n    pass\n"),
        ("tiles/products/hillshade.py", r'\A"""', '"""Other words. '),
    ) == (0, 0, 0, True)


@pytest.mark.slow
def test_a_change_of_a_cells_statistics_makes_the_tiles_stale(
    edited: Callable[..., tuple[int, int, int, bool]], finished: Simulated
) -> None:
    footprints, tiles, _, complete = edited(("tiles/cells.py", r"(class TileCells.*\n)", r"\1    another = 1\n"))
    assert (footprints, complete) == (0, False)
    assert tiles == tiles_of(finished)


@pytest.mark.slow
def test_a_change_of_a_product_makes_its_files_stale_alone(edited: Callable[..., tuple[int, int, int, bool]]) -> None:
    footprints, tiles, products, complete = edited(("tiles/products/tile_table.py", r"\Z", "\n"))
    assert (footprints, tiles, products, complete) == (0, 0, 0, True)
    changed = ("tiles/products/tile_table.py", r"(    def write\(\n)", r"    another = 1\n\n\1")
    assert edited(changed)[:3] == (0, 0, 1)


@pytest.mark.slow
def test_a_change_of_placing_makes_footprints_and_tiles_stale(
    edited: Callable[..., tuple[int, int, int, bool]], finished: Simulated
) -> None:
    footprints, tiles, _, _ = edited(("georeference/charts.py", r"(class Charts.*\n)", r"\1    another = 1\n"))
    assert footprints > 0
    assert tiles == tiles_of(finished)
