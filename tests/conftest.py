"""Fixtures shared by all tests."""

from __future__ import annotations

import functools
import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer.testing
from hypothesis import settings

import roadscan  # noqa: F401 — before NumPy: it settles the last bits of libraries, as in a process of a worker
from tests.drawing import blank
from tests.measuring.drive import measured_drive
from tests.surveys import adjusted, finished, raw_site, simulated
from tests.workshop import damage, far_apart_place, place, places, workshop

__all__ = [
    "adjusted", "damage", "far_apart_place", "finished", "measured_drive", "place", "places", "raw_site", "simulated",
    "workshop",
]  # fmt: skip
"""Fixtures of surveys and of products."""

REPOSITORY = Path(__file__).resolve().parent.parent

# One thread for linear algebra, as on workers: those of two processes would wait for one another, busily.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Numba words an error for each signature that does not fit, and forgets it: without colours that takes half as long.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

# A test's files need not outlive the machine, and a run waits a hundred times for the disk. Tests of a loss of power
# put a disk of their own in this place.
os.fsync = lambda _: None
os.environ.setdefault("OGR_SQLITE_SYNCHRONOUS", "OFF")

# On a build server the same examples each time; at home new ones.
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")


# The command line is put together once a process, as it is for a user, and not at each of two thousand commands.
typer.testing._get_command = functools.cache(typer.testing._get_command)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out tests of the own codecs where libraries do their work."""
    if item.get_closest_marker("own_codecs") and os.environ.get("ROADSCAN_CODECS") == "library":
        pytest.skip("libraries alone: ROADSCAN_CODECS")


def pytest_collection_finish() -> None:
    """Let Python's collector pass over what the imports left: looking through it takes a twentieth of the time."""
    gc.freeze()
    gc.set_threshold(100_000)


def pytest_unconfigure() -> None:
    """Let it look again, or DuckDB tells of all that is left at the end."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of the real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("ROADSCAN_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: set ROADSCAN_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def faults(recordings: Path) -> Path:
    """Folder of inputs that are wrong, beside that of the recordings; the test is skipped where it is absent."""
    folder = recordings.parent / "faults"
    if not folder.is_dir():
        pytest.skip(f"no wrong inputs at {folder}")
    return folder


@pytest.fixture(scope="session", autouse=True)
def blank_pictures() -> Iterator[None]:
    """Tests that look at drawings ask for them (:func:`tests.drawing.drawn`)."""
    with blank():
        yield
