"""Which code counts for a key: all that can be come across, and nothing else."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from roadscan.run import keys
from roadscan.run.keys import CARRIERS, code_digest, reached_code

PARTS = {
    "__init__.py": "",
    "maker.py": '''
"""Makes."""
from typing import TYPE_CHECKING

from added_package import below
from added_package.handed import helper
from added_package.tuples import LEFT as TURN

if TYPE_CHECKING:
    from added_package.kinds import Kind

SCALE = 2
UNUSED = 3


class Maker:
    """Docstring."""

    def make(self, kind: "Kind") -> int:
        """Docstring."""
        from added_package.late import late

        return SCALE * helper(kind.size) + late() + below.deep() + TURN


def other() -> int:
    return UNUSED
''',
    "handed.py": "from added_package.origin import helper\n",
    "origin.py": "def helper(size):\n    return size\n\n\ndef neighbour():\n    return 1\n",
    "kinds.py": "from dataclasses import dataclass\n\n\n@dataclass\nclass Kind:\n    size: int = 1\n",
    "late.py": "_FIRST, _SECOND = 1, 2\n\n\ndef late():\n    return _SECOND\n",
    "below.py": "def deep():\n    return 1\n",
    "tuples.py": "LEFT, RIGHT = range(2)\nregistry = {}\nregistry['x'] = 1\n",
}


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of another project, which adds a class of its own."""
    folder = tmp_path / "added_package"
    folder.mkdir()
    for name, text in PARTS.items():
        (folder / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield folder
    for name in [n for n in sys.modules if n.partition(".")[0] == "added_package"]:
        del sys.modules[name]
    forget()


def forget() -> None:
    for known in (keys._file_of, keys._module, keys._digest_of, keys._kept_outlines):
        known.cache_clear()


def digest() -> str:
    forget()
    return code_digest("added_package.maker:Maker")


def edited(file: Path, old: str, new: str) -> bool:
    """True if an edit changes the digest."""
    text, before = file.read_text(), digest()
    assert old in text
    file.write_text(text.replace(old, new))
    after = digest()
    file.write_text(text)
    assert digest() == before
    return after != before


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("maker.py", "SCALE * helper", "SCALE + helper"),
        ("maker.py", "SCALE = 2", "SCALE = 4"),
        ("origin.py", "return size", "return size + 1"),
        ("kinds.py", "size: int = 1", "size: int = 2"),
        ("late.py", "1, 2", "2, 1"),
        ("below.py", "return 1", "return 2"),
        ("tuples.py", "range(2)", "range(1, 3)"),
        ("tuples.py", "registry['x'] = 1", "registry['x'] = 2"),
    ],
    ids=["own", "constant", "handed on", "annotated", "imported late", "module", "tuple", "statement of a module"],
)
def test_an_edit_of_what_is_reached_counts(package: Path, file: str, old: str, new: str) -> None:
    assert edited(package / file, old, new)


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("maker.py", "UNUSED = 3", "UNUSED = 4"),
        ("maker.py", "return UNUSED", "return 5"),
        ("origin.py", "return 1", "return 2"),
        ("maker.py", '"""Docstring."""', '"""Another\n    text."""'),
        ("origin.py", "    return size", "    # why\n\n    return size"),
        ("maker.py", "SCALE * helper(kind.size)", "(\n            SCALE * helper(kind.size)\n        )"),
        ("maker.py", "SCALE", "FACTOR"),
    ],
    ids=["constant of another", "another", "neighbour", "docstring", "comment", "line breaks", "name"],
)
def test_an_edit_beside_it_does_not(package: Path, file: str, old: str, new: str) -> None:
    assert not edited(package / file, old, new)


def test_a_file_that_moves_does_not_count(package: Path) -> None:
    before = digest()
    (package / "room").mkdir()
    (package / "origin.py").rename(package / "room" / "source.py")
    (package / "handed.py").unlink()
    maker = package / "maker.py"
    text = maker.read_text().replace("added_package.handed import helper", "added_package.room.source import help_out")
    maker.write_text(text.replace("helper(", "help_out("))
    source = package / "room" / "source.py"
    source.write_text(source.read_text().replace("def helper", "def help_out"))
    assert digest() == before


def test_a_type_of_arrays_counts_alike_whether_written_or_imported(package: Path) -> None:
    """In two modules, so that one definition for both would number all that follow otherwise."""
    imported = "from roadscan.compute.array_types import Float64\n"
    written = "import numpy as np\nimport numpy.typing as npt\nFloat64 = npt.NDArray[np.float64]\n"
    files = [package / "origin.py", package / "late.py"]
    texts = [
        (package / "origin.py").read_text().replace("helper(size)", "helper(size: Float64)"),
        (package / "late.py").read_text().replace("late()", "late() -> Float64"),
    ]
    digests = []
    for head in (written, imported, written.replace("float64", "float32")):
        for file, text in zip(files, texts, strict=True):
            file.write_text(head + text)
        digests.append(digest())
    assert digests[0] == digests[1] != digests[2]


def test_another_function_of_a_library_counts(package: Path) -> None:
    maker = package / "maker.py"
    maker.write_text("from math import floor as whole\n" + maker.read_text().replace("late()", "whole(late())"))
    assert edited(maker, "import floor as", "import ceil as")


def test_a_new_file_does_not_count(package: Path) -> None:
    before = digest()
    (package / "new.py").write_text("def helper(size):\n    return 0\n")
    assert digest() == before


def test_an_entry_that_is_gone_is_told() -> None:
    with pytest.raises(LookupError, match=r"roadscan\.tiles\.tasks\.tiles:no_such_thing"):
        code_digest("roadscan.tiles.tasks.tiles:no_such_thing")


def test_every_carrier_exists() -> None:
    for carrier in CARRIERS:
        keys._place_of(carrier)


def test_the_tiles_reach_what_shapes_them_and_no_settings_of_other_stages() -> None:
    reached = reached_code(["roadscan.tiles.tasks.tiles:compute_tiles"])
    modules = {place.partition(":")[0] for place in reached}
    assert {
        "roadscan.poses.trajectory:Corrections",
        "roadscan.georeference.charts:Charts",
    } <= reached.keys()
    assert {"roadscan.ingest.clock_correction", "roadscan.tiles.cells", "roadscan.core.crs"} <= modules
    rooms = ("inspect", "simulate", "surfaces", "condition", "assets", "adjust", "cli", "products.hillshade")
    assert not [m for m in modules if m.startswith(tuple(f"roadscan.{room}" for room in rooms))]
    assert not [
        p
        for p in reached
        if p.startswith(("roadscan.core.settings.navigation:Smoother", "roadscan.core.settings.calibration:C"))
    ]


def test_the_adjustment_reaches_no_code_that_planned_its_sources() -> None:
    """Logs and trajectories count by the keys of the sources that come of them."""
    modules = {p.partition(":")[0] for p in reached_code(["roadscan.adjust.tasks.adjustment:adjust_survey"])}
    assert {"roadscan.adjust.estimation", "roadscan.adjust.control", "roadscan.georeference.place"} <= modules
    rooms = ("ingest.planned_logs", "ingest.inspect", "navigation.inertial", "navigation.odometry", "simulate")
    assert not [m for m in modules if m.startswith(tuple(f"roadscan.{room}" for room in rooms))]


def test_outlines_are_kept_for_the_next_process(package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are used as long as they are whole, of this very source, and where nobody else may write."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    before = digest()
    (kept,) = tmp_path.glob("kept/roadscan/outlines-*/added_package.maker.json")
    with monkeypatch.context() as patch:
        patch.setattr(keys.ast, "parse", None)
        assert digest() == before
    whole = kept.read_bytes()
    for damaged in (b"", b"{}", whole[:50], whole.replace(b'"brought"', b'"other"')):
        kept.write_bytes(damaged)
        assert digest() == before
        assert kept.read_bytes() == whole
    other = whole.replace(b"value=2,", b"value=3,")
    kept.write_bytes(other)
    assert digest() != before
    kept.parent.chmod(0o777)
    assert digest() == before
