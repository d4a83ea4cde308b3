"""Files that no format claims: `inspect`, `init` and `run` say of each what is wrong with it, in the same words."""

from __future__ import annotations

import bz2
import ctypes
import gzip
import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest

from tests.answers import roadscan
from tests.ingest.test_inspect import sbet

SURVEY = """
id = "x"
store = "store"
[map]
local = {{ name = "x" }}
[[runs]]
id = "one"
[[runs.logs]]
path = "{name}"
"""


def table(names: str, rows: int = 10) -> bytes:
    width = names.count(",") + 1
    return "\n".join([names, *(",".join([str(i)] * width) for i in range(rows)), ""]).encode()


def records(count: int) -> bytes:
    return sbet(200_000 + np.arange(count) / 200).astype("<f8").tobytes()


def parquet() -> bytes:
    out = io.BytesIO()
    pq.write_table(pa.table({"epoch_gps_ns": [1, 2, 3]}), out)
    return out.getvalue()


def feather() -> bytes:
    out = io.BytesIO()
    pa.feather.write_feather(pa.table({"x": [1, 2, 3]}), out)
    return out.getvalue()


POSES = "time_s,latitude_deg,longitude_deg,height_m,roll,pitch,heading"

CASES: list[tuple[str, Callable[[], bytes], list[str]]] = [
    ("a.sbet", bytes, ["the file is empty"]),
    (
        "short.sbet",
        lambda: bytes(range(100)),
        ["by its name it is sbet", "the file has 100 bytes; expected records of"],
    ),
    ("a.parquet", lambda: parquet()[:-20], ["a Parquet table that is cut off"]),
    ("a.feather", lambda: feather()[:-20], ["an Arrow table that is cut off"]),
    ("a.csv.gz", lambda: gzip.compress(table(POSES, 1000))[:30], ["the gzip file is cut off after 0"]),
    ("d.csv.gz", lambda: gzip.compress(b"x")[:10] + b"x" * 10, ["the gzip file is damaged after 0"]),
    ("a.clf.bz2", lambda: bz2.compress(b"x" * 10_000)[:40], ["the bzip2 file is cut off"]),
    ("a.csv", lambda: table(POSES), ["nearest to trajectory_csv", "columns 'roll', 'pitch', 'heading'", "roll_deg"]),
    ("b.csv.gz", lambda: gzip.compress(table(POSES)), ["the columns come nearest to trajectory_csv"]),
    ("c.csv", lambda: table("time_s,lat_deg,lon_deg,height_m,roll_deg"), ["no column holds pitch, heading"]),
    ("d.csv", lambda: table("name,Easting (ft),northing_m,height_m"), ["nearest to control_csv", 'unit = "ft"']),
    ("e.csv", lambda: table("1,2,3,4"), ["4 columns of numbers, and no line names them"]),
    ("a.bin", lambda: np.random.default_rng(1).bytes(5_000), ["binary data of no known kind: the content is"]),
    ("a.txt", lambda: b"rain from ten o'clock\n", ["text: the content is of no known raw format"]),
]


@pytest.mark.parametrize(("name", "content", "said"), CASES, ids=[f"{c[0]} {c[2][0][:30]}" for c in CASES])
def test_what_is_wrong_is_said_in_the_same_words(
    tmp_path: Path, name: str, content: Callable[[], bytes], said: list[str]
) -> None:
    (tmp_path / name).write_bytes(content())
    (tmp_path / "SURVEY.toml").write_text(SURVEY.format(name=name))
    looked = roadscan("inspect", tmp_path / name)
    ran = roadscan("ingest", tmp_path / "SURVEY.toml", "--workers", "0")
    assert looked.exit_code == 2
    assert ran.exit_code != 0
    for words in (" ".join(looked.output.split()), f"{ran.output}{ran.exception}"):
        assert [part for part in said if part not in words] == [], words
        assert "velodyne_pcap" not in words  # no list of all formats


def test_a_log_inside_gzip_is_to_be_unpacked_only_where_its_reader_needs_that(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "drive.sbet").write_bytes(records(200))
    (logs / "packed.sbet.gz").write_bytes(gzip.compress(records(200)))
    (logs / "units.csv.gz").write_bytes(gzip.compress(table(POSES)))
    (logs / "notes.txt.gz").write_bytes(gzip.compress(b"rain\n"))
    done = roadscan("init", logs, "--out", tmp_path / "SURVEY.toml")
    lines = {line.split(": ")[1]: line for line in done.stdout.splitlines() if line.startswith("not understood")}
    assert "a gzip file with a log of sbet in it, which is read unpacked only; unpack it" in lines["packed.sbet.gz"]
    assert "nearest to trajectory_csv" in lines["units.csv.gz"]
    assert [name for name, line in lines.items() if "unpack" in line] == ["packed.sbet.gz"]


def without_rights() -> None:
    """Take from root what opens files whatever their permissions: CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH."""
    if os.getuid() == 0:
        for right in (1, 2):
            ctypes.CDLL(None).prctl(24, right, 0, 0, 0)  # PR_CAPBSET_DROP


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="rights are taken away by Linux's own call")
def test_a_file_that_may_not_be_opened(tmp_path: Path) -> None:
    """Also one in a folder that may not be entered; a run says the same of both."""
    closed = tmp_path / "closed"
    closed.mkdir()
    paths = [tmp_path / "a.sbet", closed / "b.sbet"]
    for path in paths:
        path.write_bytes(records(10))
        path.chmod(0)
    logs = '\n[[runs.logs]]\npath = "closed/b.sbet"\nformat = "sbet"\n'
    (tmp_path / "SURVEY.toml").write_text(SURVEY.format(name="a.sbet") + logs)
    closed.chmod(0)
    for words in (["inspect", *map(str, paths)], ["ingest", str(tmp_path / "SURVEY.toml"), "--workers", "0"]):
        command = [sys.executable, "-m", "roadscan", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=without_rights)
        said = " ".join((done.stdout + done.stderr).split())
        assert done.returncode == 2, done.stderr
        assert "it cannot be opened: Permission denied; give this user the right to read it" in said
        assert all(str(path.name) in said for path in paths)  # a run names both before the words
        assert "Traceback" not in done.stderr
    closed.chmod(0o755)
