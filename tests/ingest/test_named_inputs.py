"""Files of other programs: read, or named with the way out."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from roadscan.cli import app


@pytest.mark.parametrize(
    ("file", "words"),
    [
        (
            "opencrg_fileref.crg",
            "the header only refers to the data file '../crg-txt/handmade_curved_banked_sloped.crg'",
        ),
        ("opencrg_handmade_platform.crg", "161 rows of cloud"),
        ("pnezd_named.csv", "Ground control and check points as CSV"),
        ("german_semicolon_decimal_comma_bom.csv", "Ground control and check points as CSV"),
        ("track.gpx", "104 rows of gnss"),
        ("ublox_ubx_nmea_mixed.log", "u-blox recording (UBX): navigation solutions of NAV-PVT"),
    ],
)
def test_inspect_says_what_it_is(faults: Path, file: str, words: str) -> None:
    found = CliRunner().invoke(app, ["inspect", str(faults / file)])
    assert words in " ".join(found.output.split())
