"""How commands end: one line and an exit status, whatever ends them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from roadscan.simulate import simulate
from roadscan.survey.status import verify_store
from tests.conftest import REPOSITORY
from tests.surveys import Simulated, outputs, small_scene

ROADSCAN = [sys.executable, "-m", "roadscan"]
UNWRITABLE = Path("/sys")
"""No process makes files there, not even one of root."""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """4 m of road by profilers alone."""
    scene = small_scene(length_m=4.0, lidar={"on": False})
    return Simulated(simulate(scene, tmp_path_factory.mktemp("tiny") / "survey").survey_file)


def heard() -> None:
    """Let signals be heard that whoever runs the tests ignores, as a shell does for its jobs in the background."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


def roadscan(*arguments: object, cwd: Path = REPOSITORY) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own."""
    return subprocess.run([*ROADSCAN, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, check=False)


def in_one_line(done: subprocess.CompletedProcess[str], *words: str) -> None:
    """It failed, and said why in one line with these words."""
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if not line.startswith("read: ")]
    assert len(lines) == 1, done.stderr
    assert all(word in lines[0] for word in words), lines[0]


@pytest.mark.parametrize(
    ("number", "workers"),
    [
        (signal.SIGINT, "2"),
        (signal.SIGTERM, "0"),
        pytest.param(signal.SIGTERM, "2", marks=pytest.mark.nightly),
        pytest.param(signal.SIGINT, "0", marks=pytest.mark.nightly),
    ],
)
def test_a_signal_to_the_whole_group_ends_a_run_with_one_line(
    tiny: Simulated, tmp_path: Path, number: signal.Signals, workers: str
) -> None:
    """As a terminal sends Ctrl-C: to the run and all its workers. The next run ends with the same files."""
    copy = tiny.copy_to(tmp_path / "survey")
    command = [*ROADSCAN, "run", str(copy.survey_file), "--workers", workers]
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
        start_new_session=True,
        preexec_fn=heard,  # noqa: PLW1509
    ) as run:
        assert run.stderr is not None
        said = ""
        while not said.startswith(("footprints: 0 of", "tiles: 0 of")):
            said = run.stderr.readline()
            assert said, "the run ended before it was stopped"
        os.killpg(run.pid, number)
        rest = run.stderr.read().splitlines()
    assert run.returncode == 128 + number
    lines = [line for line in rest if not line.startswith(("footprints:", "tiles:"))]
    assert len(lines) == 1, rest
    assert lines[0].startswith("roadscan: stopped: ")
    assert number.name in lines[0]
    assert lines[0].endswith("; the next run goes on from there")
    assert not Path(copy.store().path("manifest/lock")).exists()
    copy.run()
    if not (tiny.survey_file.parent / "store").exists():
        tiny.run()
    assert outputs(copy.store()) == outputs(tiny.store())
    assert verify_store(copy.store()) == []


INTERRUPTED_WRITER = """
import os, signal, sys
import lazrs
from roadscan.cli import main

class Interrupting:
    def __init__(self, stream):
        self._stream = stream
    def write(self, content):
        if not asked:
            asked.append(True)
            os.kill(os.getpid(), signal.SIGINT)
        return self._stream.write(content)
    def __getattr__(self, name):
        return getattr(self._stream, name)

asked, compressor = [], lazrs.LasZipCompressor
lazrs.LasZipCompressor = lambda stream, *words: compressor(Interrupting(stream), *words)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv = ["roadscan", "run", sys.argv[1], "--workers", "0"]
main()
"""
"""The command line, with Ctrl-C as soon as the LAZ library, in Rust, calls back to write."""


@pytest.mark.slow
def test_a_signal_that_a_library_makes_an_error_of_its_own_of_ends_a_run(tiny: Simulated, tmp_path: Path) -> None:
    copy = tiny.copy_to(tmp_path / "survey")
    copy.survey_file.write_text(copy.survey_file.read_text() + '\n[products]\nmake = ["las"]\n')
    command = [sys.executable, "-c", INTERRUPTED_WRITER, str(copy.survey_file)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=False)
    assert done.returncode == 128 + signal.SIGINT, done.stderr
    assert done.stderr.splitlines()[-1].startswith("roadscan: stopped: Ctrl-C (SIGINT); in the stage tiles, 0 of ")
    assert "failed" not in done.stderr
    assert done.stdout == ""


def test_a_reader_that_has_seen_enough_ends_a_command_without_a_word() -> None:
    command = [*ROADSCAN, "formats"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=REPOSITORY) as one:
        assert one.stdout is not None and one.stderr is not None
        one.stdout.close()  # before a line was printed
        assert one.stderr.read() == b""
    assert one.returncode == 1


def test_a_folder_in_place_of_a_survey_file_is_one_line(tmp_path: Path) -> None:
    in_one_line(roadscan("run", tmp_path), str(tmp_path), "this is a folder")


@pytest.mark.slow
@pytest.mark.skipif(not UNWRITABLE.is_dir(), reason="no folder is known that nobody may write to")
def test_a_place_that_must_not_be_written_is_one_line(tiny: Simulated, tmp_path: Path) -> None:
    place = UNWRITABLE / "roadscan"
    raw = tiny.survey_file.parent / "raw"
    in_one_line(roadscan("init", raw, "--out", UNWRITABLE / "SURVEY.toml"), "/sys/SURVEY.toml", "permission denied")
    scene = tmp_path / "scene.toml"
    scene.write_text("length_m = 2.0\n[lidar]\non = false\n")
    in_one_line(roadscan("simulate", scene, "--out", place), str(place), "permission denied")
    text = tiny.survey_file.read_text()
    elsewhere = tiny.survey_file.with_name("elsewhere.toml")
    elsewhere.write_text(f'store = "{place}"\n{text}')
    in_one_line(roadscan("run", elsewhere, "--workers", 0), str(place), "the store cannot be written")
