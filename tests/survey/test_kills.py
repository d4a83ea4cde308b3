"""Runs that are killed again and again, on a folder and on an object store: same bytes, and nothing half is seen.

`ROADSCAN_KILLS` says how often each of the two is killed.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from roadscan.store.logs import read_log_records
from roadscan.store.manifest import Manifest
from roadscan.store.store import Store
from roadscan.survey.status import verify_store
from tests.conftest import REPOSITORY
from tests.object_store import served
from tests.surveys import Simulated, outputs

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(0)]
KILLS = int(os.environ.get("ROADSCAN_KILLS", "20"))
LONGEST_S = 6.0
"""Processor time within which a run is killed: most of a whole run's."""
STEPS = ("manifest/outputs", "tables/footprints", "tiles", "products", "manifest/logs", "")
"""What is taken away from a finished store, to be made again: `""` is all of it."""


def see(store: Store, gone: str) -> None:
    """Look as a reader does, who takes no lock: what a record names is there, in its size, or was taken away."""
    for record in read_log_records(store):
        for file in (one for own in record.tables.values() for one in own):
            assert store.size(file.path) == file.bytes, file.path
    for output in Manifest(store).all():
        found = store.size(output.path) if output.path else output.bytes
        assert found == output.bytes or (found is None and output.path.startswith(gone or "?")), output.path


def kill_often(copy: Simulated, store: Store, chance: random.Random) -> None:
    command = [sys.executable, "-m", "tests.survey.killed_run", "run", str(copy.survey_file), "--workers", "0"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as runs:
        assert runs.stdin is not None and runs.stdout is not None
        kills, steps, gone = 0, 0, "?"
        while kills < KILLS:
            print(chance.uniform(0.0, LONGEST_S), file=runs.stdin, flush=True)
            ended = runs.stdout.readline().strip()
            assert ended in {"killed", "0"}
            see(store, gone)
            if ended == "killed":
                kills += 1
                if kills % 20 == 0:
                    print(f"{store.url}: {kills} kills", file=sys.__stderr__, flush=True)
                continue
            assert verify_store(store) == []
            gone = STEPS[steps % len(STEPS)]
            steps += 1
            if gone:
                store.remove(gone)
            else:
                store.fs.rm(store.root, recursive=True)
        print(1e9, file=runs.stdin, flush=True)
        assert runs.stdout.readline().strip() == "0"
        runs.stdin.close()


def same(one: Store, other: Store) -> None:
    made, expected = outputs(one), outputs(other)
    assert made.keys() == expected.keys()
    assert [path for path in made if made[path] != expected[path]] == []
    assert verify_store(one) == []


def test_a_folder(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    kill_often(copy, copy.store(), random.Random(27))
    same(copy.store(), finished.store())


def test_an_object_store(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_to(tmp_path / "survey")
    with served() as objects:
        text = copy.survey_file.read_text()
        assert "\nstore" not in text
        copy.survey_file.write_text(f'store = "{objects.url}/kills"\n{text}')
        store = Store(f"{objects.url}/kills", finished.store().survey_id)
        kill_often(copy, store, random.Random(28))
        same(store, finished.store())
