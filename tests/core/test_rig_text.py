"""Changes to a rig file: only what is meant changes, every other byte stays."""

from __future__ import annotations

import datetime as dt
import stat
import tomllib
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from roadscan.core.errors import ConfigError
from roadscan.core.rig import Rig
from roadscan.core.rig_text import changed_rig_text, update_rig_file

RIG = '''# The van of 2026 — "blue" [sensors.camera] is not a table here
name = "van"   # as painted

[sensors.lidar]
kind = "lidar"
axes = "flu"
lever_arm_body_m = [
  -1.7,  # forward
  0.06,  # right ]
  -1.36,
]
boresight = { roll_deg = 1.0, pitch_deg = 18.0 }

  [ sensors . "camera" ]   # the front one
kind = "camera"
model = """a # [sensors.camera]
interior = 3"""
lever_arm_body_m = [0.9, -0.25, -1.15]# measured with a tape

# what follows is the GNSS antenna
[sensors.gnss]
kind = 'gnss'
model = 'C:\\new # x'
'''
INTERIOR = {
    "width_px": 960,
    "height_px": 600,
    "focal_px": (820.5, 821.0),
    "principal_px": (479.5, 299.5),
    "date": dt.date(2026, 3, 1),
}


def test_a_table_is_added_and_nothing_else_moves():
    out = changed_rig_text(RIG, "camera", {"interior": INTERIOR})
    added = (
        "\n[sensors.camera.interior]\nwidth_px = 960\nheight_px = 600\nfocal_px = [820.5, 821.0]\n"
        "principal_px = [479.5, 299.5]\ndate = 2026-03-01\n"
    )
    place = RIG.index("\n# what follows")
    assert out == RIG[:place] + added + RIG[place:]
    interior = Rig.parse(tomllib.loads(out)).sensors["camera"].interior
    assert interior is not None
    assert interior.focal_px == (820.5, 821.0)
    assert interior.date == dt.date(2026, 3, 1)


def test_values_are_replaced_where_they_stand():
    out = changed_rig_text(
        RIG, "camera", {"lever_arm_body_m": [0.91, -0.24, -1.1], "lever_arm_sigma_m": [0.01, 0.02, 0.03]}
    )
    assert out == RIG.replace(
        "[0.9, -0.25, -1.15]# measured with a tape\n",
        "[0.91, -0.24, -1.1]# measured with a tape\nlever_arm_sigma_m = [0.01, 0.02, 0.03]\n",
    )
    out = changed_rig_text(RIG, "lidar", {"boresight": {"roll_deg": 1.25}, "lever_arm_body_m": [1.0, 2.0, 3.0]})
    assert "boresight = { roll_deg = 1.25 }\n" in out
    assert "lever_arm_body_m = [1.0, 2.0, 3.0]\nboresight" in out
    assert out.endswith(RIG[RIG.index("\n\n  [ sensors") :])


def test_an_existing_table_is_replaced_key_by_key():
    stated = RIG + (
        "\n[sensors.camera.interior] # from the lab\nwidth_px = 1 # w\nrms_px = 0.3\nheight_px = 2\n"
        "focal_px = [\n1.0, 2.0]\nprincipal_px = [1, 2]"
    )
    out = changed_rig_text(stated, "camera", {"interior": INTERIOR})
    assert out.startswith(RIG + "\n[sensors.camera.interior] # from the lab\nwidth_px = 960 # w\nheight_px = 600\n")
    assert "rms_px" not in out
    assert out.endswith("principal_px = [479.5, 299.5]\ndate = 2026-03-01\n")
    again = changed_rig_text(out, "camera", {"interior": INTERIOR})
    assert again == out


def test_line_ends_stay(tmp_path: Path):
    file = tmp_path / "RIG.toml"
    file.write_bytes(RIG.replace("\n", "\r\n").encode())
    update_rig_file(file, "camera", {"interior": INTERIOR})
    assert file.read_bytes().decode() == changed_rig_text(RIG, "camera", {"interior": INTERIOR}).replace("\n", "\r\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[sensors]\ncamera = { kind = "camera" }\n', "table of its own"),
        ('[sensors]\ncamera.kind = "camera"\n', "table of its own"),
        ('sensors.camera.kind = "camera"\n', "table of its own"),
        ('[sensors.camera]\nkind = "camera"\ninterior.width_px = 3\n', "dotted keys"),
        ('[sensors.camera]\nkind = "camera"\n[sensors.camera.interior]\na.b = 3\n', "dotted keys"),
        ('[sensors.lidar]\nkind = "lidar"\n', "no sensor 'camera'"),
        ('[sensors.cameras]\nkind = "camera"\n', "did you mean 'cameras'"),
    ],
)
def test_files_that_are_not_changed_safely_are_refused(text: str, words: str):
    with pytest.raises(ConfigError, match=words):
        changed_rig_text(text, "camera", {"interior": INTERIOR})


def test_the_file_is_replaced_at_once_or_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "RIG.toml"
    file.write_text(RIG, encoding="utf-8")
    file.chmod(0o640)
    with pytest.raises(ConfigError, match="focal_px"):
        update_rig_file(file, "camera", {"interior": {"width_px": 3, "height_px": 4}})
    with pytest.raises(ConfigError, match="unknown key"):
        update_rig_file(file, "camera", {"focus": 3.0})
    assert file.read_text(encoding="utf-8") == RIG

    def fails(*_: object) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as broken:
        broken.setattr(Path, "replace", fails)
        with pytest.raises(ConfigError, match="no space left"):
            update_rig_file(file, "camera", {"interior": INTERIOR})
    assert file.read_text(encoding="utf-8") == RIG
    assert list(tmp_path.iterdir()) == [file]
    rig = update_rig_file(file, "camera", {"interior": INTERIOR})
    assert rig == Rig.load(file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert list(tmp_path.iterdir()) == [file]


COMMENT = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=20)


@pytest.mark.slow
@given(
    name=st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), min_size=1, max_size=8),
    comments=st.lists(COMMENT, min_size=4, max_size=4),
    text=COMMENT,
    newline=st.sampled_from(["\n", "\r\n"]),
)
def test_any_name_and_any_comment(name: str, comments: list[str], text: str, newline: str):
    assume(name != "other")
    quoted = '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    lines = [
        f"#{comments[0]}", f"[sensors.{quoted}]#{comments[1]}", 'kind = "camera"', f'model = "{escaped}"#{comments[2]}',
        f"lever_arm_body_m = [1, #{comments[3]}", "2, 3]", "[sensors.other]", 'kind="imu"',
    ]  # fmt: skip
    before = newline.join(lines)
    out = changed_rig_text(before, name, {"interior": INTERIOR, "lever_arm_sigma_m": [0.1, 0.2, 0.3]})
    values = tomllib.loads(out)["sensors"]
    assert values[name]["model"] == text
    assert values[name]["interior"]["date"] == dt.date(2026, 3, 1)
    assert [line for line in out.split(newline) if line in lines] == lines
