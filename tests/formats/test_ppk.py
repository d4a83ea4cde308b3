"""Post-processed GNSS: recordings of two reference stations, and observations computed from satellites' orbits."""

from __future__ import annotations

import gzip
import os
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.core.survey import Survey
from roadscan.core.toml_text import toml
from roadscan.formats.motion import rtklib_programs
from roadscan.formats.motion.ppk_checks import Separation, Track
from roadscan.ingest.reading.format import format_of
from roadscan.store.query.sql import query
from roadscan.store.store import Store
from tests.answers import roadscan
from tests.drawing import drawn
from tests.formats.gnss_observations import SKY, ecef, enu_axes, navigation, observe, rinex2, rinex3, sp3, ubx
from tests.formats.log_reading import Log, read_log

pytestmark = pytest.mark.skipif(
    shutil.which("rnx2rtkp") is None, reason="RTKLIB is not on PATH: apt-get install rtklib"
)

REPOSITORY = Path(__file__).resolve().parents[2]
ROVER, BASE, ORBITS = "07590920.05o", "30400920.05o", "30400920.05n"
BASE_M = (-3978241.958, 3382840.234, 3649900.853)
ROVER_DEG, ROVER_M = (35.160865959, 139.613843021), ecef(35.160865959, 139.613843021, 68.381)
"""Stated with the recordings: shared/data/README.md."""
SURVEY = """
id = "quay"
rig = { sensors = { gnss = { kind = "gnss", lever_arm_body_m = [0.0, 0.0, 0.0] } } }
[map]
crs = "EPSG:6677"
[[runs]]
id = "one"
logs = [{ path = "07590920.05o", format = "ppk", sensor = "gnss" }]
[navigation.ppk]
navigation = ["30400920.05n"]
mode = "MODE"
[navigation.ppk.base]
files = ["30400920.05o"]
crs = "EPSG:6666"
x_m = -3978241.958
y_m = 3382840.234
z_m = 3649900.853
antenna_height_m = 0.0
"""

PLACE = (48.1, 11.5, 560.0)
MARK_M, AXES = ecef(*PLACE), enu_axes(*PLACE[:2])
TIMES_S = np.arange(0.0, 60.0)


def drive(t: float) -> np.ndarray:
    """A circle of 200 m at 15 m/s, 500 m from the base."""
    turn = 15.0 * t / 200.0
    return MARK_M + np.array([300 + 200 * np.sin(turn), 400 - 200 * np.cos(turn), 2 * np.sin(t / 40)]) @ AXES


ROVER_SEEN = observe(drive, TIMES_S, 1)
BASE_SEEN = observe(lambda t: MARK_M, TIMES_S, 2)


def sample(folder: Path) -> Path:
    """Twelve epochs of a rover, a base and orbits."""
    (folder / "brdc.nav").write_text(navigation())
    (folder / "base.obs").write_text(rinex2(BASE_SEEN[:12], MARK_M))
    (folder / "rover.obs").write_text(rinex2(ROVER_SEEN[:12], drive(0.0)))
    return folder / "rover.obs"


def sample_ubx(folder: Path) -> Path:
    """The same rover as UBX."""
    sample(folder).unlink()
    (folder / "rover.ubx").write_bytes(ubx(ROVER_SEEN[:12]))
    return folder / "rover.ubx"


def sample_options(**changes: Any) -> dict[str, Any]:
    """Settings of the simulated files, with those of the base changed."""
    base = {"files": ["base.obs"], "crs": "EPSG:7930", "antenna_height_m": 0.0}
    position = {name: float(x) for name, x in zip(("x_m", "y_m", "z_m"), MARK_M, strict=True)}
    base = {name: value for name, value in (base | position | changes).items() if value is not None}
    return {"base": base, "navigation": ["brdc.nav"]}


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute's drive as RINEX 2 and 3 and as UBX."""
    folder = tmp_path_factory.mktemp("ppk")
    (folder / "brdc.nav").write_text(navigation())
    (folder / "base.obs").write_text(rinex2(BASE_SEEN, MARK_M))
    (folder / "rover.obs").write_text(rinex2(ROVER_SEEN, drive(0.0)))
    (folder / "rover.rnx").write_text(rinex3(ROVER_SEEN, drive(0.0)))
    (folder / "rover.obs.gz").write_bytes(gzip.compress((folder / "rover.obs").read_bytes()))
    (folder / "rover.ubx").write_bytes(ubx(ROVER_SEEN))
    (folder / "base.ubx").write_bytes(ubx(BASE_SEEN))
    return folder


def off_enu_m(log: Log) -> np.ndarray:
    """Errors (n, 3) of a simulated drive."""
    t = log.epochs / 1e9 - SKY.week * 604_800 - SKY.toe_s
    return (log.positions - [drive(one) for one in t]) @ AXES.T


@pytest.fixture
def quay(recordings: Path, tmp_path: Path) -> Path:
    for file in (recordings / "rinex").iterdir():
        shutil.copyfile(file, tmp_path / file.name)
    return tmp_path


# --- recordings ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "plane_m", "up_m"), [("static", 0.002, 0.004), ("kinematic", 0.035, 0.09)])
def test_the_recorded_rover_through_a_survey(quay: Path, mode: str, plane_m: float, up_m: float) -> None:
    """Each epoch; the last one, of five satellites, is the worst of the kinematic solution."""
    file = quay / "SURVEY.toml"
    file.write_text(SURVEY.replace("MODE", mode))
    done = roadscan("run", file, "--workers", "0")
    assert done.exit_code == 0, done.output
    store = Store(str(quay / "store"), "quay")
    rows = query(store, "SELECT * FROM gnss ORDER BY epoch_gps_ns").to_pandas()
    off = (rows[["x_world_m", "y_world_m", "z_world_m"]].to_numpy() - ROVER_M) @ enu_axes(*ROVER_DEG).T
    assert len(rows) == 115 and set(rows["quality"]) == {"fixed"}
    assert np.hypot(off[:, 0], off[:, 1]).max() < plane_m and np.abs(off[:, 2]).max() < up_m
    assert np.hypot(off[:-1, 0], off[:-1, 1]).max() < 0.013 and np.abs(off[:-1, 2]).max() < 0.023
    assert query(store, "SELECT sum(records) AS n FROM rejects").to_pylist() == [{"n": 5}]
    assert [p.endswith(".png") for p in store.files("products/navigation")] == [True]
    again = roadscan("ingest", file, "--workers", "0")
    assert "known: one/gnss" in again.output and "read:" not in again.output


@pytest.mark.slow
def test_the_recorded_rover_through_the_command(quay: Path) -> None:
    out = quay / "out" / "rover.pos"
    words = ["--base", quay / BASE, "--base-position", ",".join(map(str, BASE_M)), "--base-crs", "EPSG:4978@2005.25"]
    words += ["--base-antenna-height", "0", "--navigation", quay / ORBITS, "--option", "mode=static", "--out", out]
    with drawn():
        done = roadscan("ppk", quay / ROVER, *words)
    assert done.exit_code == 0, done.output
    assert re.search(r"fixed +115\b", done.output) and "doubtful" not in done.output
    log = read_log("rtklib_pos", out, crs="EPSG:4979")
    assert np.linalg.norm(log.positions - ROVER_M, axis=1).max() < 0.005
    assert "EPSG:4978, epoch 2005.25" in out.read_text()
    with Image.open(out.with_suffix(".png")) as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 24) or ()}
    assert (0x3D, 0x8B, 0x40) in colours  # fixed


@pytest.mark.witness("ppk_base_place")
def test_a_base_of_orthometric_height_is_refused(quay: Path) -> None:
    base = {"files": [BASE], "crs": "EPSG:6667", "antenna_height_m": 0.0, "latitude_deg": 35.132057068,
            "longitude_deg": 139.624306577, "height_m": 73.9077 - 37.0}  # fmt: skip
    with pytest.raises(RoadscanError, match=r"\+3\d\.\d m up; the approximate position in its file is -3978242\.435"):
        read_log("ppk", quay / ROVER, {"base": base, "navigation": [ORBITS]})
    log = read_log(
        "ppk", quay / ROVER, {"base": base | {"height_m": 73.9077}, "navigation": [ORBITS], "mode": "static"}
    )
    assert np.linalg.norm(log.positions - ROVER_M, axis=1).max() < 0.005


# --- a simulated drive -----------------------------------------------------------------------------


@pytest.mark.parametrize("direction", ["combined", "forward", "backward"])
def test_a_drive_comes_out_where_it_was(driven: Path, direction: str) -> None:
    log = read_log("ppk", driven / "rover.obs", sample_options() | {"direction": direction})
    off = off_enu_m(log)
    assert len(off) == 60 and set(log.column("quality")) == {"fixed"} and log.findings == []
    assert np.abs(off[:, :2]).max() < 0.02 and np.abs(off[:, 2]).max() < 0.06
    sigma = np.stack([log.column(f"sigma_{a}_m") for a in ("east", "north", "down")], axis=-1)
    assert 0.2 < np.sqrt(np.mean((off / sigma) ** 2)) < 1.5


@pytest.mark.parametrize(
    ("rover", "base"), [("rover.rnx", "base.obs"), ("rover.obs.gz", "base.obs"), ("rover.ubx", "base.ubx")]
)
def test_other_files_give_the_same(driven: Path, rover: str, base: str) -> None:
    log = read_log("ppk", driven / rover, sample_options(files=[base]))
    same = read_log("ppk", driven / "rover.obs", sample_options())
    assert format_of(driven / rover).name == "ppk"
    assert np.abs(log.positions - same.positions).max() < 0.002


def test_damaged_messages_are_counted(driven: Path) -> None:
    whole = bytearray((driven / "rover.ubx").read_bytes())
    whole[len(whole) // 2 + 50] ^= 0xFF
    (driven / "damaged.ubx").write_bytes(whole)
    log = read_log("ppk", driven / "damaged.ubx", sample_options(files=["base.ubx"]))
    assert len(log.epochs) == 59 and [(one.records, one.reason[:16]) for one in log.rejects] == [
        (1, "the message RXM-")
    ]


def test_antenna_heights(driven: Path) -> None:
    """The base's mark is 2 m below its antenna, the wanted point 1.5 m below the rover's."""
    lower = {name: float(x) for name, x in zip(("x_m", "y_m", "z_m"), MARK_M - 2 * AXES[2], strict=True)}
    options = sample_options(antenna_height_m=2.0, **lower)
    assert np.abs(off_enu_m(read_log("ppk", driven / "rover.obs", options))).max() < 0.06
    off = off_enu_m(read_log("ppk", driven / "rover.obs", options | {"antenna_height_m": 1.5}))
    assert np.abs(off.mean(axis=0) - [0.0, 0.0, -1.5]).max() < 0.03


def test_antennas_with_other_phase_centres(driven: Path) -> None:
    """Phase centres 60 mm (rover) and 20 mm (base) above the reference point lower the rover by 40 mm."""
    lines = []
    for name, up_mm in (("HIGH", 60.0), ("LOW", 20.0)):
        lines += [
            f"{name:<16}{'':45}AVE =    0",
            *[f"{0.0:10.1f}{0.0:10.1f}{up_mm:10.1f}", *["   .0" * 10, "   .0" * 9]] * 2,
        ]
    (driven / "antennas.pcv").write_text("\n".join(lines) + "\n")
    plain = read_log("ppk", driven / "rover.obs", sample_options())
    options = sample_options(antenna="LOW") | {"antenna": "HIGH", "antenna_calibration": "antennas.pcv"}
    moved = (read_log("ppk", driven / "rover.obs", options).positions - plain.positions) @ AXES.T
    assert np.abs(moved.mean(axis=0) - [0.0, 0.0, -0.04]).max() < 0.003


def test_precise_orbits_go_before_the_broadcast_ones(driven: Path) -> None:
    """The broadcast orbits are 2.7 km off along the way: code observations contradict one another."""
    (driven / "late.nav").write_text(navigation(ahead_rad=1e-4))
    (driven / "igs.sp3").write_text(sp3())
    late = sample_options() | {"navigation": ["late.nav"]}
    with pytest.raises(RoadscanError, match="found no position of the base at any epoch"):
        read_log("ppk", driven / "rover.obs", late)
    log = read_log("ppk", driven / "rover.obs", late | {"precise": ["igs.sp3"]})
    assert np.abs(off_enu_m(log)[:, :2]).max() < 0.02 and np.abs(off_enu_m(log)[:, 2]).max() < 0.06


@pytest.mark.witness("ppk_common_time")
def test_a_base_of_another_time(driven: Path, tmp_path: Path) -> None:
    for name in ("rover.obs", "brdc.nav"):
        shutil.copyfile(driven / name, tmp_path / name)
    (tmp_path / "base.obs").write_text(rinex2(observe(lambda t: MARK_M, TIMES_S + 7200.0, 2), MARK_M))
    with pytest.raises(
        RoadscanError, match=r"no common time: the rover observed 2024-05-15T11:59:42\S* to .*T13:59:42"
    ):
        read_log("ppk", tmp_path / "rover.obs", sample_options())
    (tmp_path / "base.obs").write_text(rinex2(BASE_SEEN[:20], MARK_M))
    log = read_log("ppk", tmp_path / "rover.obs", sample_options() | {"max_age_s": 5.0})
    (finding,) = log.findings
    assert "35 of the rover's 60 epochs" in finding.text
    assert len(log.epochs) + sum(one.records for one in log.rejects) == 60 and log.table.num_rows <= 25


@pytest.mark.witness("ppk_fixed")
def test_ambiguities_that_are_not_fixed(driven: Path) -> None:
    log = read_log("ppk", driven / "rover.obs", sample_options() | {"ambiguities": "off"})
    assert [one.witness for one in log.findings] == ["ppk_fixed"]
    assert "Of 60 epochs with a position, 0 have fixed" in log.findings[0].text


@pytest.mark.witness("ppk_directions")
def test_directions_that_contradict_each_other() -> None:
    """A fifth of the epochs is off by one wave of L1 in one direction."""
    epochs, sigma = np.arange(100, dtype=np.int64) * 10**9, np.full((100, 3), 0.01)
    places = np.tile(MARK_M, (100, 1))
    wrong = places + np.where(np.arange(100)[:, None] < 20, 0.19, 0.0) * AXES[0]
    fixed = np.ones(100, bool)
    same = Track(epochs, places, sigma, fixed)
    assert Separation.of(same, same, "EPSG:7930").findings() == []
    (found,) = Separation.of(same, Track(epochs, wrong, sigma, fixed), "EPSG:7930").findings()
    assert "differ at 20 of them" in found.text and "0.190 m east" in found.text


@pytest.mark.witness("ppk_antenna_height")
def test_antenna_heights_that_are_not_stated(driven: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="height of the base's antenna above its mark is not stated"):
        read_log("ppk", driven / "rover.obs", sample_options(antenna_height_m=None))
    for name in ("base.obs", "brdc.nav"):
        shutil.copyfile(driven / name, tmp_path / name)
    (tmp_path / "rover.obs").write_text(rinex2(ROVER_SEEN, drive(0.0), antenna_height_m=1.8))
    with pytest.raises(ConfigError, match=r"its file says 1\.8000 m"):
        read_log("ppk", tmp_path / "rover.obs", sample_options())
    log = read_log("ppk", tmp_path / "rover.obs", sample_options() | {"antenna_height_m": 0.0})
    assert "stated as 0.0000 m, its file says 1.8000 m" in log.findings[0].text
    assert np.abs(off_enu_m(log)).max() < 0.06


@pytest.mark.witness("ppk_antenna_height")
def test_heights_of_zero_in_the_files_are_named_as_perhaps_unknown(driven: Path) -> None:
    log = read_log("ppk", driven / "rover.obs", sample_options(antenna_height_m=1.5) | {"antenna_height_m": 1.2})
    base, rover = (one.text for one in log.findings if one.text.startswith("The height of the"))
    assert "base's antenna is stated as 1.5000 m, its file says 0.0000 m" in base and "do not know it" in base
    assert "rover's antenna is stated as 1.2000 m" in rover


# --- what is never guessed -------------------------------------------------------------------------


def test_the_bases_position_is_never_that_of_its_header(driven: Path) -> None:
    with pytest.raises(ConfigError, match="approximate position in the header of its file is not used") as error:
        read_log("ppk", driven / "rover.obs", {"navigation": ["brdc.nav"]})
    assert [one.key for one in error.value.asks_for("options.base")] == ["options.base"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"crs": "EPSG:4978"}, "the epoch of the base's is not stated"),
        ({"crs": "EPSG:7789"}, "the epoch of the base's is not stated"),
        ({"crs": "EPSG:4258"}, "is not geocentric"),
        ({"x_m": None}, "all three of one kind"),
        ({"files": ["brdc.nav"]}, "base's file holds no observations"),
    ],
)
def test_bases_that_are_refused(driven: Path, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(RoadscanError, match=words):
        read_log("ppk", driven / "rover.obs", sample_options(**changes))


def test_a_height_without_its_kind_is_refused(driven: Path) -> None:
    geodetic = {"x_m": None, "y_m": None, "z_m": None, "latitude_deg": 48.1, "longitude_deg": 11.5, "height_m": 560.0}
    with pytest.raises(ConfigError, match="is not geographic with three axes"):
        read_log("ppk", driven / "rover.obs", sample_options(crs="EPSG:4258", **geodetic))
    with pytest.raises(RoadscanError, match="another datum"):
        read_log("ppk", driven / "rover.obs", sample_options(), crs="EPSG:4979")


def test_orbits_have_to_be_stated(driven: Path) -> None:
    with pytest.raises(ConfigError, match="no navigation file"):
        read_log("ppk", driven / "rover.obs", sample_options() | {"navigation": []})


def test_without_rtklib_the_package_is_named(driven: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match=r"rnx2rtkp of RTKLIB, which is not on PATH; .*apt-get install rtklib"):
        read_log("ppk", driven / "rover.obs", sample_options())


def test_another_program_computes_again(driven: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = rtklib_programs.programs_digest()
    program = tmp_path / "rnx2rtkp"
    program.write_bytes(Path(shutil.which("rnx2rtkp") or "").read_bytes() + b"\0")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert rtklib_programs.programs_digest() != before


def test_what_was_computed_is_kept_where_rtklib_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample(tmp_path)
    options = sample_options()
    base = ", ".join(f"{name} = {toml(value)}" for name, value in options["base"].items())
    file = tmp_path / "SURVEY.toml"
    file.write_text(
        'id = "one"\n[map]\ncrs = "EPSG:25832"\n[[runs]]\nid = "a"\nlogs = [{ path = "rover.obs", format = "ppk" }]\n'
        f'[navigation.ppk]\nnavigation = ["brdc.nav"]\nbase = {{ {base} }}\n'
    )
    path = os.environ["PATH"]
    monkeypatch.setenv("PATH", "")
    assert "which is not on PATH" in str(roadscan("run", file, "--workers", "0").exception)
    monkeypatch.setenv("PATH", path)
    assert "read: a/gnss" in roadscan("run", file, "--workers", "0").output
    monkeypatch.setenv("PATH", "")
    again = roadscan("run", file, "--workers", "0")
    assert again.exit_code == 0 and "known: a/gnss" in again.output
    (tmp_path / "base.obs").write_text(rinex2(BASE_SEEN[:11], MARK_M))
    assert "which is not on PATH" in str(roadscan("run", file, "--workers", "0").exception)


def test_the_section_is_for_logs_of_the_format(tmp_path: Path) -> None:
    (tmp_path / "SURVEY.toml").write_text(SURVEY.replace("MODE", "static").replace('format = "ppk", ', ""))
    with pytest.raises(ConfigError, match='no log has format = "ppk"'):
        Survey.load(tmp_path / "SURVEY.toml")


# --- the page --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_pages_commands_print_what_it_shows(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copyfile(REPOSITORY / "examples" / "real-data" / "quay.toml", tmp_path / "quay.toml")
    (tmp_path / "recordings").symlink_to(recordings)
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "ppk.md").read_text()
    shown = re.findall(r"^\$ roadscan (.*)\n((?:[^$`].*\n)*)", page, flags=re.MULTILINE)
    assert len(shown) == 3
    for words, lines in shown:
        done = roadscan(*shlex.split(words))
        assert done.exit_code == 0, done.output
        assert [one for one in lines.splitlines() if one != "…" and one.rstrip() not in done.output] == []
    survey = re.findall(r"^```toml\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)
    assert survey[0].strip() in (tmp_path / "quay.toml").read_text()


# --- looking at files ------------------------------------------------------------------------------


def test_a_rover_of_which_nothing_is_stated_is_looked_at(driven: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")  # without RTKLIB
    done = roadscan("inspect", driven / "rover.obs")
    assert done.exit_code == 0
    for words in (
        "60 rows of gnss, 1 a second",
        "options.base =",
        "options.navigation =",
        "rinex = 2.11",
        "2024-05-15",
    ):
        assert words in done.output
    assert "nan" not in done.output


def test_files_of_orbits_name_their_way(driven: Path) -> None:
    (driven / "packed.crx").write_text(f"{'1.0':<20}{'COMPACT RINEX FORMAT':<40}CRINEX VERS   / TYPE\n")
    (driven / "igs.sp3").write_text("#cP2024  5 15  0  0  0.00000000      96 ORBIT IGS20 HLM  IGS\n")
    for name, words in (("brdc.nav", "takes orbits"), ("packed.crx", "crx2rnx"), ("igs.sp3", "precise orbits")):
        done = roadscan("inspect", driven / name)
        assert words in done.output and "roadscan ppk" in done.output


def test_a_first_survey_file_asks_for_the_base(driven: Path, tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    shutil.copyfile(driven / "rover.obs", tmp_path / "logs" / "rover.obs")
    done = roadscan("init", tmp_path / "logs", "--out", tmp_path / "SURVEY.toml")
    assert done.exit_code == 0, done.output
    text = (tmp_path / "SURVEY.toml").read_text()
    assert 'format = "ppk"' in text and '#? options.base = "????"' in text and "#? options.navigation" in text
    answered = text.replace('#? options.base = "????"', "#").replace('#? options.navigation = ["????"]', "#")
    (tmp_path / "SURVEY.toml").write_text(answered.replace('#? crs = "????"', 'crs = "EPSG:25832"'))
    rig = (tmp_path / "RIG.toml").read_text()
    (tmp_path / "RIG.toml").write_text(rig.replace("#? ", "").replace("????", "0.0"))
    refused = roadscan("run", tmp_path / "SURVEY.toml")
    assert "the base station of raw GNSS observations is not stated" in str(refused.exception)
