"""The surveys of examples/real-data on the real recordings, run once for all tests; skipped where there are none.

The scripts that lie there evaluate the written files with laspy, pandas and SciPy; docs/real-data.md shows
what they print.
"""

from __future__ import annotations

import gzip
import shutil
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

import pytest

from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Reporter, Session
from roadscan.run.stage import stages
from roadscan.store.logs import LogRecord, read_log_records
from roadscan.store.store import Store
from roadscan.survey.run import run_stages

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "real-data"
sys.path.insert(0, str(EXAMPLES))


class Lines(Reporter):
    """Remembers what a run said."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def line(self, text: str) -> None:
        self.lines.append(text)


@dataclass(frozen=True)
class Place:
    """A folder as docs/real-data.md has its reader make it."""

    folder: Path

    @property
    def recordings(self) -> Path:
        return self.folder / "recordings"

    @property
    def unpacked(self) -> Path:
        return self.folder / "unpacked"

    def file(self, name: str, replaced: dict[str, str] | None = None, as_name: str = "") -> Path:
        """A survey file of the examples, with words replaced."""
        text = (EXAMPLES / name).read_text()
        for old, new in (replaced or {}).items():
            assert old in text
            text = text.replace(old, new)
        path = self.folder / (as_name or name)
        path.write_text(text)
        return path

    def run(self, survey_file: Path, *names: str) -> list[str]:
        """Run a survey in this process, all stages or those named; what it said."""
        survey = Survey.load(survey_file)
        chosen = [s for s in stages() if not names or s.name in names]
        reporter = Lines()
        run_stages(Session(survey, self.store(survey_file), Inline(), None, reporter), chosen)
        return reporter.lines

    def store(self, survey_file: Path) -> Store:
        survey = Survey.load(survey_file)
        return Store(survey.store_url, survey.config.id)

    def products(self, survey_file: Path) -> Path:
        """Folder of a survey in the store."""
        return Path(self.store(survey_file).root)

    def records(self, survey_file: Path) -> list[LogRecord]:
        return read_log_records(self.store(survey_file))


@pytest.fixture(scope="session")
def place(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Place:
    """The examples beside the recordings."""
    found = Place(tmp_path_factory.mktemp("real-data"))
    for file in EXAMPLES.glob("*.toml"):
        shutil.copy(file, found.folder)
    found.recordings.symlink_to(recordings.resolve(), target_is_directory=True)
    found.unpacked.mkdir()
    return found


@pytest.fixture(scope="session")
def kitti(place: Place) -> Path:
    """The KITTI survey, finished."""
    with tarfile.open(place.recordings / "kitti_drive" / "velodyne_points.tar.xz") as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # from Python 3.11.4
        archive.extractall(place.unpacked / "kitti_drive")
    survey_file = place.folder / "kitti.toml"
    place.run(survey_file)
    return survey_file


@pytest.fixture(scope="session")
def av2(place: Place) -> Path:
    """The Argoverse 2 survey, finished."""
    survey_file = place.folder / "av2.toml"
    place.run(survey_file)
    return survey_file


@pytest.fixture(scope="session")
def two_pass(place: Place) -> Path:
    """The Boreas poses, ingested."""
    survey_file = place.folder / "two_pass.toml"
    place.run(survey_file, "ingest")
    return survey_file


@pytest.fixture(scope="session")
def strips_las(place: Place) -> Path:
    """The vendor's cloud, decompressed."""
    path = place.unpacked / "strips.las"
    path.write_bytes(gzip.decompress((place.recordings / "formats" / "strips.las.gz").read_bytes()))
    return path
