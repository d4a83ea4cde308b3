"""Every kernel that other files call is tested by name: directly, or through the one function that calls it.

A kernel is what Python can call, or an instruction; pieces that are compiled into their callers are tested there.
"""

from __future__ import annotations

import ast
import functools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "roadscan"

THROUGH_ITS_CALLER = {
    "tiles.kernels.bucket_statistics.bucket_mirror": "tests/tiles/test_cell_path.py",
    "tiles.kernels.bucket_statistics.bucket_returns": "tests/tiles/test_cell_path.py",
    "tiles.kernels.accumulate.accumulate_profiles": "tests/tiles/test_cell_path.py",
    "compute.kernels.arrays.median": "tests/condition/test_lane_texture.py",
    "compute.kernels.arrays.selected": "tests/condition/test_lane_texture.py",
    "surface.kernels.faint_cracks.confirm_strips": "tests/surface/test_faint_cracks.py",
    "georeference.kernels.flat_profiles.georeference_flat_profiles": "tests/georeference/test_place.py",
    "poses.kernels.poses.interpolate": "tests/poses/test_trajectory.py",
    "poses.kernels.poses.interval_coefficients": "tests/poses/test_trajectory.py",
    "georeference.kernels.flat_profiles.profile_forms": "tests/georeference/test_place.py",
    "georeference.kernels.reach.reach_of_profiles": "tests/georeference/test_reach.py",
    "georeference.kernels.reach.reach_of_returns": "tests/georeference/test_reach.py",
    "georeference.kernels.timed_readings.georeference_mirror": "tests/georeference/test_place.py",
    "georeference.kernels.timed_readings.georeference_returns": "tests/georeference/test_place.py",
    "georeference.kernels.timed_readings.places": "tests/georeference/test_place.py",
    "navigation.inertial.kernels.kalman.filter_forwards": "tests/navigation/test_inertial_smoother.py",
    "navigation.inertial.kernels.kalman_smoother.spread": "tests/navigation/test_inertial_smoother.py",
    "navigation.inertial.kernels.kalman.advance": "tests/navigation/test_inertial_smoother.py",
    "navigation.inertial.kernels.kalman.predict": "tests/navigation/test_inertial_smoother.py",
    "navigation.inertial.kernels.kalman_updates.apply": "tests/navigation/test_inertial_smoother.py",
    "navigation.inertial.kernels.kalman_updates.offered": "tests/navigation/test_inertial_smoother.py",
    "navigation.inertial.kernels.kalman_updates.prepare": "tests/navigation/test_inertial_smoother.py",
    "georeference.kernels.segmentation.mark_off_road": "tests/georeference/test_segmentation.py",
    "georeference.kernels.segmentation.fitted": "tests/georeference/test_segmentation.py",
    "georeference.kernels.segmentation.segment_profiles": "tests/georeference/test_segmentation.py",
    "surface.kernels.delaunay.in_circle": "tests/kernels/test_natural_neighbour.py",
    "surface.kernels.delaunay.turn": "tests/kernels/test_natural_neighbour.py",
    "surface.kernels.clough_tocher.control_points": "tests/surface/test_detailed.py",
    "surface.kernels.clough_tocher.cross_slopes": "tests/surface/test_detailed.py",
    "surface.kernels.clough_tocher.evaluate": "tests/surface/test_detailed.py",
    "surface.kernels.spline_gradients.load": "tests/surface/test_detailed.py",
    "surface.kernels.spline_gradients.spline_gradients": "tests/surface/test_detailed.py",
    "surface.kernels.spline_gradients.vertex_gradients": "tests/surface/test_detailed.py",
    "surface.kernels.delaunay.neighbourhoods": "tests/surface/test_detailed.py",
}
"""Kernels whose input takes a room to make, and the test that holds what comes out against truth from outside."""


COMPILED = {"kernel", "bare", "inner", "bare_inner"}


def kernels_of(file: Path) -> Iterator[str]:
    """Public kernels of a file that Python or other kernels call, and instructions."""
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            if COMPILED & {ast.unparse(decorator) for decorator in node.decorator_list}:
                yield node.name
        elif isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) == "Kernel":
            yield ast.unparse(node.target)


def kernel_files() -> list[Path]:
    """Files of kernels but those of the simulator, which its truth is tested by."""
    return [file for file in LIBRARY.rglob("kernels/*.py") if "simulate" not in file.parts]


@functools.cache
def imported(file: Path) -> set[str]:
    """Dotted names that a file imports from the kernels, or uses of a module of theirs."""
    text = file.read_text(encoding="utf-8")
    if ".kernels" not in text:
        return set()
    tree = ast.parse(text)
    found: set[str] = set()
    modules: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and "kernels" in (node.module or "").split("."):
            for alias in node.names:
                name = f"{node.module}.{alias.name}".removeprefix("roadscan.")
                found.add(name)
                modules[alias.asname or alias.name] = name
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            found.add(f"{modules[node.value.id]}.{node.attr}")
    return found


def names_in(*folders: str) -> dict[Path, set[str]]:
    return {file: imported(file) for folder in folders for file in (ROOT / folder).rglob("*.py")}


@pytest.mark.slow
def test_every_kernel_is_tested_by_name() -> None:
    library, tests = names_in("roadscan"), set().union(*names_in("tests").values())
    wanted = set()
    for file in kernel_files():
        module = ".".join(file.relative_to(LIBRARY).with_suffix("").parts)
        elsewhere = set().union(*(names for other, names in library.items() if other != file))
        wanted |= {f"{module}.{name}" for name in kernels_of(file)} & elsewhere
    assert len(wanted) > 100
    untested = wanted - tests - set(THROUGH_ITS_CALLER)
    # Kernels of codecs are held against the libraries that know them by tests of tables and products.
    assert sorted(name for name in untested if not name.startswith("store.codecs.")) == []


def test_what_is_tested_through_its_caller_exists_and_is_not_tested_directly() -> None:
    tests = set().union(*names_in("tests").values())
    for name, place in THROUGH_ITS_CALLER.items():
        module, _, kernel = name.rpartition(".")
        assert kernel in kernels_of(LIBRARY / f"{module.replace('.', '/')}.py"), name
        assert (ROOT / place).is_file(), place
        assert name not in tests, f"{name} has a direct test now"


MOST_PARAMETERS, MOST_FILES = 12, 25


def test_kernels_take_structures_and_rooms_stay_small() -> None:
    """What belongs together is one parameter; a room is read in an hour."""
    long = {}
    for file in (ROOT / "roadscan").rglob("kernels/**/*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and len(node.args.args) > MOST_PARAMETERS:
                long[f"{file.stem}.{node.name}"] = len(node.args.args)
    assert long == {}
    files = Counter(file.parent for file in (ROOT / "roadscan").rglob("*.py"))
    assert {folder.name for folder, count in files.items() if count > MOST_FILES} == set()
