"""The file of control that people click: several programs at once, and files that are none."""

from __future__ import annotations

import csv
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from roadscan.core.errors import ConfigError
from roadscan.pictures.points import ClickedPoints


def click(file: Path, picture: int) -> None:
    """A program that writes and takes back and writes again."""
    held, place = ClickedPoints(file), ("run-1", "camera", f"{picture:06d}.jpg", "P1")
    held.put(place, (10.0, 20.25), None)
    held.put(place, None, (10.0, 20.25))
    held.put(place, (11.0, float(picture)), None)


def test_programs_that_write_at_once_lose_nothing(tmp_path: Path) -> None:
    file = tmp_path / "clicked.csv"
    with ProcessPoolExecutor(4) as pool:
        list(pool.map(click, [file] * 24, range(24)))
    with file.open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["picture"], float(row["v_px"])) for row in rows] == [(f"{k:06d}.jpg", float(k)) for k in range(24)]
    assert {row["source"] for row in rows} == {"by hand"} and [p.name for p in tmp_path.iterdir()] == [file.name]


def test_what_somebody_else_measured_is_not_replaced(tmp_path: Path) -> None:
    held, place = ClickedPoints(tmp_path / "clicked.csv"), ("run-1", "camera", "a.jpg", "P1")
    held.put(place, (1.0, 2.0), None)
    for pixel, before in (((3.0, 4.0), None), (None, (1.0, 2.5)), ((3.0, 4.0), (0.0, 0.0))):
        with pytest.raises(ConfigError, match="in another window meanwhile"):
            held.put(place, pixel, before)
    assert [(row["u_px"], row["v_px"]) for row in held.rows()] == [(1.0, 2.0)]
    held.put(place, (3.0, 4.0), (1.0, 2.0))
    assert held.put(place, None, (3.0, 4.0)) == []


@pytest.mark.parametrize("text", ["name;x\nP1;3\n", "picture,point,u_px,v_px\na.jpg,P1,one,2\n", "\x00"])
def test_a_file_that_is_none_is_named_and_stays(tmp_path: Path, text: str) -> None:
    file = tmp_path / "clicked.csv"
    file.write_text(text)
    with pytest.raises(ConfigError, match="cannot be read"):
        ClickedPoints(file).put(("run-1", "camera", "a.jpg", "P1"), (1.0, 2.0), None)
    assert file.read_text() == text
