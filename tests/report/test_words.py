"""What commands say of files that are not what they should be, in words that tell what is wrong, and of numbers."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import pytest
from typer.testing import CliRunner

from docs.mistakes import SURVEY, Mistake, run, write_sbet, write_survey
from roadscan.cli import app
from roadscan.cli.summaries import print_summary
from roadscan.core.survey import Survey
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store

CAPTURE = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, 1)
"""Header of a capture (libpcap)."""


def said(*arguments: object) -> tuple[int, str]:
    """Exit code of a command, and all that it printed, as one line."""
    result = CliRunner().invoke(app, [*map(str, arguments)])
    told = f"{result.output}{result.exception or ''}"
    return result.exit_code, " ".join(told.split())


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("ends_in_a_packet_header.pcap", CAPTURE + b"123456"),
        ("ends_in_a_packet.pcap", CAPTURE + struct.pack("<IIII", 0, 0, 1248, 1248) + bytes(50)),
        ("big_endian.pcap", struct.pack(">IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, 1) + b"123456"),
        ("magic.las", b"LASF"),
        ("header.las", b"LASF" + bytes(100)),
    ],
)
def test_a_file_that_ends_inside_its_header_is_cut_off(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    code, text = said("inspect", tmp_path / name)
    assert code == 2 and "cut off" in text and "fetch it again" in text
    write_sbet(tmp_path / "poses.sbet")  # a folder without any log is an error
    code, text = said("init", tmp_path, "--out", tmp_path / "SURVEY.toml")
    assert f"{name}: " in text and "cut off" in text


def test_a_capture_without_packets_is_not_cut_off(tmp_path: Path) -> None:
    (tmp_path / "empty.pcap").write_bytes(CAPTURE)
    assert "cut off" not in said("inspect", tmp_path / "empty.pcap")[1]


def test_a_survey_file_that_is_no_text_is_told_so(tmp_path: Path) -> None:
    write_survey(tmp_path, Mistake("none", ""))
    code, text = run("run", str(tmp_path / "scans.parquet"))
    assert code == 2 and "scans.parquet: the file is no text; expected a file in TOML" in text and "codec" not in text


@pytest.mark.parametrize(("numbers", "given"), [("1.0, 2.0", 2), ("", 0)])
def test_a_list_that_is_too_short_says_how_long_it_has_to_be(tmp_path: Path, numbers: str, given: int) -> None:
    write_survey(tmp_path, Mistake("none", ""))
    (tmp_path / "SURVEY.toml").write_text(SURVEY.replace("0.0, 0.0, 0.0", numbers))
    code, text = run("status", str(tmp_path / "SURVEY.toml"))
    assert code == 2 and f"lever_arm_body_m': expected a list of 3 ({given} given)" in text
    assert text.count("lever_arm_body_m") == 1


def test_inspect_says_that_a_run_does_not_read_a_packed_sbet(tmp_path: Path) -> None:
    write_sbet(tmp_path / "poses.sbet")
    (tmp_path / "poses.sbet.gz").write_bytes(gzip.compress((tmp_path / "poses.sbet").read_bytes()))
    code, text = said("inspect", tmp_path / "poses.sbet.gz")
    assert code == 0 and "a run reads such a log unpacked only" in text
    assert "read unpacked only; unpack it" in said("init", tmp_path, "--out", tmp_path / "SURVEY.toml")[1]


def test_init_tells_first_of_a_folder_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "SURVEY.toml").touch()
    code, text = said("init", tmp_path / "nothere", "--out", tmp_path / "SURVEY.toml")
    assert code != 0 and "there is no such folder" in text and "overwritten" not in text


def test_status_lists_a_log_whose_accuracy_file_is_missing(tmp_path: Path) -> None:
    write_survey(tmp_path, Mistake("none", ""))
    write_sbet(tmp_path / "poses.sbet")
    old = SURVEY[SURVEY.index('path = "poses.csv"') : SURVEY.index('\n\n[[runs.logs]]\npath = "scans')]
    clock = 'format = "sbet"\ncrs = "EPSG:4937"\nclock = { system = "gps_week_seconds", week = 2417 }'
    new = f'path = "poses.sbet"\n{clock}\noptions = {{ accuracy = "gone.out" }}'
    (tmp_path / "SURVEY.toml").write_text(SURVEY.replace(old, new))
    code, text = said("status", tmp_path / "SURVEY.toml")
    assert code == 1 and "monday poses.sbet cannot be read" in text and "gone.out" in text


def test_one_is_no_plural_and_long_names_keep_apart_from_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    survey = Survey.load(write_survey(tmp_path, Mistake("none", "")))
    store = Store(str(tmp_path / "store"), "street")
    Manifest(store).add([OutputRecord("pothole_pieces", "5_5", "key", "tiles/pothole_pieces/5_5.parquet", 7, "", "")])
    print_summary(survey, store)
    assert "pothole_pieces  1 file, 7 bytes, in " in capsys.readouterr().out
    code, text = said("verify", tmp_path / "SURVEY.toml")
    assert code == 1 and text.removesuffix(" 1").endswith("1 file is not whole")
