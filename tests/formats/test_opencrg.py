"""OpenCRG: bytes as the format's documentation has them, round trips, refusals, damage."""

from __future__ import annotations

import datetime as dt
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roadscan.core.errors import ConfigError, CrsError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.formats.clouds.opencrg_file import CurvedRegularGrid, MapOffset, write_crg
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.crg_files import read_crg
from tests.formats.readings import read

EPOCH = dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)
EPOCH_GPS_NS = (1_777_887_000 - 315_964_800 + 18) * 10**9
OPTIONS: dict[str, Any] = {"epoch": EPOCH}
LOCAL = {"crs": "local"}

# The example of the section "Road data" of the ASAM OpenCRG 1.2 specification (its header's second
# LONG_SECTION_V_RIGHT is a slip there and is the left border here).
SPECIFICATION = """\
$ROAD_CRG                         ! road parameters section
REFERENCE_LINE_INCREMENT =  0.50  ! 50 cm between every lateral cut
LONG_SECTION_V_RIGHT     = -0.50  ! right road border
LONG_SECTION_V_LEFT      =  0.50  ! left road border
LONG_SECTION_V_INCREMENT =  0.50  ! 50 cm between every longitudinal cut
$!******10********20********30********40********50********60********70**
$KD_DEFINiTION                    ! data definition section
#:LRFI                            ! plain-text data, real numbers
D:reference line phi,rad          ! heading angle
D:long section 1,m                ! 0.50m right of reference line
D:long section 2,m                !             on reference line
D:long section 3,m                ! 0.50m  left of reference line
$!******10********20********30********40********50********60********70**
* Sample payload data, 4 channels as defined by "D:" above:
$$!*****10********20********30********40********50********60********70********80
 *missing* 0.0000000 0.0000000 0.0000000
 0.0000000 0.0000000 0.0000000 0.0000000
-0.0110000 0.0000000 0.0000000 0.0000000
-0.0110000 0.0111111 0.0111111 0.0000000
 0.0000000 0.0000000 0.0000000 0.0000000
 0.0110000 *missing* 0.0000000 0.0111111
 0.0220000-0.0111111 0.0111111 0.0222222
 0.0330000-0.0111111 0.0222222 0.0333333
 0.0440000-0.0111111 0.0111111 0.0222222
 0.0550000-0.0000000 0.0000000 0.0111111
"""


def written(folder: Path, content: str | bytes, name: str = "a.crg") -> Path:
    path = folder / name
    path.write_bytes(content.encode("latin-1") if isinstance(content, str) else content)
    return path


def binary(encoding: str, rows: list[list[float]], head: str = "", channels: list[str] | None = None) -> bytes:
    """A binary file by the documentation, independent of the writer."""
    names = channels or [f"D:long section {k + 1},m" for k in range(len(rows[0]))]
    text = "\n".join(["$ROAD_CRG", head, "$", "$KD_DEFINITION", f"#:{encoding}", *names, "$", "$$$$", ""])
    code, fill = ("f", 20) if encoding == "KRBI" else ("d", 10)
    values = [v for row in rows for v in row]
    values += [math.nan] * (-len(values) % fill)
    return text.encode() + struct.pack(f">{len(values)}{code}", *values)


# --- the file ----------------------------------------------------------------------------------------


def test_the_example_of_the_specification(tmp_path: Path) -> None:
    grid = read_crg(written(tmp_path, SPECIFICATION))
    assert grid.v_m.tolist() == [-0.5, 0.0, 0.5]
    assert grid.z_m.shape == (10, 3)
    assert grid.z_m[6].tolist() == [-0.0111111, 0.0111111, 0.0222222]
    assert np.argwhere(np.isnan(grid.z_m)).tolist() == [[5, 0]]
    headings = [0.0, -0.011, -0.011, 0.0, 0.011, 0.022, 0.033, 0.044, 0.055]
    assert np.ravel(grid.phi_rad).tolist() == headings
    x, y = 0.0, 0.0
    line = grid.reference_line_m()
    for k, heading in enumerate(headings):  # each heading leads from the row before to its own
        x, y = x + 0.5 * math.cos(heading), y + 0.5 * math.sin(heading)
        assert line[k + 1] == pytest.approx([x, y, 0.0], abs=1e-12)


def test_a_lost_long_section_is_noticed(tmp_path: Path) -> None:
    lost = SPECIFICATION.replace("D:long section 3,m", "D:lon\x1a section 3,m")
    with pytest.raises(FormatError, match=r"2 long sections .* end at 0 m, not at the left border, 0\.5 m"):
        read_crg(written(tmp_path, lost))


def test_damage_in_the_geometry_is_not_read_as_defaults(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"no block \$ROAD_CRG"):
        read_crg(written(tmp_path, SPECIFICATION.replace("$ROAD_CRG", "$ROAD_CR\0")))
    with pytest.raises(FormatError, match="no text"):
        read_crg(written(tmp_path, SPECIFICATION.replace("REFERENCE_LINE_INCREMENT", "REFEREN\x1a\0LINE_INCREMENT")))


def test_defaults_of_a_minimal_file(tmp_path: Path) -> None:
    """Rows 0.01 m apart where the header says nothing, columns centred (crg_read.m, crgLoader.c)."""
    head = "$ROAD_CRG\n$\n$KD_DEFINITION\n#:LRFI\nD:long section 2,m\nD:long section 1,m\nD:long section 3,m\n$\n$$$$\n"
    grid = read_crg(written(tmp_path, head + " 0.2000000 0.1000000 0.3000000\n 0.5000000 0.4000000 0.6000000\n"))
    assert grid.v_m == pytest.approx([-0.01, 0.0, 0.01])
    assert grid.u_step_m == 0.01
    assert grid.z_m.tolist() == [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]


def test_the_virtual_channel_states_u_where_the_header_does_not(tmp_path: Path) -> None:
    channels = ["U:reference line u,m,100.0,0.25", "D:long section at v = 0.5,m", "D:long section at v = -1.0,m"]
    grid = read_crg(written(tmp_path, binary("KRBI", [[1.0, 2.0], [3.0, 4.0]], channels=channels)))
    assert (grid.u_start_m, grid.u_step_m) == (100.0, 0.25)
    assert grid.v_m.tolist() == [-1.0, 0.5]
    assert grid.z_m.tolist() == [[2.0, 1.0], [4.0, 3.0]]
    data = binary("KRBI", [[1.0, 2.0], [3.0, 4.0]], "REFERENCE_LINE_INCREMENT = 0.5D0", channels)
    assert read_crg(written(tmp_path, data)).u_step_m == 0.5


@pytest.mark.parametrize("encoding", ["KRBI", "KDBI"])
def test_binary_records_big_endian_and_filled(tmp_path: Path, encoding: str) -> None:
    rows = [[1.5, -2.25, math.nan], [0.5, 0.25, 0.125], [4.0, 5.0, 6.0]]
    grid = read_crg(written(tmp_path, binary(encoding, rows)))
    assert np.array_equal(grid.z_m, rows, equal_nan=True)  # 9 values, filled up to 20 or 10


def test_text_of_several_lines_a_row(tmp_path: Path) -> None:
    names = "".join(f"D:long section {k},m\n" for k in range(1, 11))
    head = f"$ROAD_CRG\n$\n$KD_DEFINITION\n#:LDFI\n{names}$\n$$$$\n"
    row = "".join(f"{k + 0.125:20.13f}" for k in range(4)), "".join(f"{k:20d}" for k in range(4, 8)), f"{8:20d}{9:20d}"
    grid = read_crg(written(tmp_path, head + "\n".join([*row, *row]) + "\n\n"))
    assert grid.z_m.tolist() == [[0.125, 1.125, 2.125, 3.125, 4, 5, 6, 7, 8, 9]] * 2


def test_a_circle(tmp_path: Path) -> None:
    """Nodes beside an arc of radius R lie at R − v from its centre, but for the mitre's stretch of the chord."""
    radius, step, rows = 50.0, 0.5, 101
    turn = 2 * math.asin(step / 2 / radius)
    headings = math.radians(30.0) + turn * (np.arange(rows - 1) + 0.5)
    v = np.array([-3.0, 0.0, 3.0])
    slope = np.full(rows - 1, 0.02)
    banking = np.linspace(0.0, 0.04, rows)
    grid = CurvedRegularGrid(
        v, np.zeros((rows, 3)), step, x_start_m=1000.0, y_start_m=2000.0, z_start_m=10.0, phi_rad=headings, slope=slope,
        banking=banking,
    )  # fmt: skip
    centre = np.array([1000.0, 2000.0]) + radius * np.array([-math.sin(math.radians(30)), math.cos(math.radians(30))])
    xyz = grid.xyz()[1:-1]
    distance = np.linalg.norm(xyz[..., :2] - centre, axis=-1)
    assert np.allclose(distance, radius - v / math.cos(turn / 2), atol=1e-9)
    u = step * np.arange(rows)[1:-1, None]
    assert np.allclose(xyz[..., 2], 10.0 + 0.02 * u + banking[1:-1, None] * v, atol=1e-12)


def test_the_closing_error_is_spread(tmp_path: Path) -> None:
    channels = ["D:reference line phi,rad", "D:reference line slope,m/m", "D:long section 1,m", "D:long section 2,m"]
    rows = [[math.nan, math.nan, 0.0, 0.0]] + [[0.0, 0.0, 0.0, 0.0]] * 4
    head = "\n".join(
        ["REFERENCE_LINE_INCREMENT = 1", "REFERENCE_LINE_START_X = 10", "REFERENCE_LINE_START_Y = 0",
         "REFERENCE_LINE_END_X = 14.4", "REFERENCE_LINE_END_Y = 0.8", "REFERENCE_LINE_END_Z = 0.4"]
    )  # fmt: skip
    line = read_crg(written(tmp_path, binary("KDBI", rows, head, channels))).reference_line_m()
    x, y, z = [10.0], [0.0], [0.0]
    for k in range(1, 5):  # the forward loop of crg_check_data.m, written out
        back, weight = 14.4 - (4 - k), k / 4
        x.append((1 - weight) * (x[-1] + 1.0) + weight * back)
        y.append((1 - weight) * y[-1] + weight * 0.8)
        z.append((1 - weight) * z[-1] + weight * 0.4)
    assert np.allclose(line, np.column_stack([x, y, z]), atol=1e-12)


def test_the_offset_turns_about_the_start_and_shifts() -> None:
    """crg_map_local2global of OpenCRG's MATLAB tools, worked by hand: a quarter turn about (10, 20)."""
    offset = MapOffset(1000.0, 2000.0, 50.0, math.pi / 2)
    grid = CurvedRegularGrid(
        np.array([0.0, 1.0]), np.zeros((2, 2)), 2.0, x_start_m=10.0, y_start_m=20.0, z_start_m=5.0, offset=offset
    )
    expected = [[[1010, 2020, 55], [1009, 2020, 55]], [[1010, 2022, 55], [1009, 2022, 55]]]
    assert np.allclose(grid.xyz(), expected, atol=1e-9)


heights = hnp.arrays(
    np.float64, hnp.array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=13),
    elements=st.one_of(st.just(math.nan), st.floats(-99.0, 99.0, width=32).filter(lambda x: x == 0 or abs(x) > 1e-6)),
)  # fmt: skip


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(z=np.full((2, 13), -0.0078125), encoding="LRFI", curved=False, uneven=False, start=(0.0, 0.0, 0.0), seed=0)
@given(
    z=heights,
    encoding=st.sampled_from(["KRBI", "KDBI", "LRFI", "LDFI"]),
    curved=st.booleans(),
    uneven=st.booleans(),
    start=st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-100, 4000)),
    seed=st.integers(0, 99),
)
def test_round_trip(
    tmp_path: Path,
    z: np.ndarray,
    encoding: Any,
    curved: bool,
    uneven: bool,
    start: tuple[float, float, float],
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = z.shape
    channels: dict[str, Any] = {"phi_rad": 0.25, "slope": 0.01, "banking": -0.02}
    if curved:
        channels = {
            "phi_rad": 0.5 + 0.01 * rng.standard_normal(rows - 1),
            "slope": 0.01 * rng.standard_normal(rows - 1),
            "banking": 0.01 * rng.standard_normal(rows),
        }
    v = np.sort(rng.choice(np.arange(-20, 20), columns, replace=False)) * 0.125 if uneven else 0.1 * np.arange(columns)
    grid = CurvedRegularGrid(
        v, z, 0.05, u_start_m=12.5, x_start_m=start[0], y_start_m=start[1], z_start_m=start[2],
        comments=("roadscan",), **channels,
    )  # fmt: skip
    path = tmp_path / "a.crg"
    write_crg(grid, path, encoding)
    back = read_crg(path)
    digits, least = {"KRBI": (1e-7, 0), "KDBI": (0, 0), "LRFI": (1e-5, 1e-7), "LDFI": (1e-15, 1e-17)}[encoding]
    assert back.comments == ("roadscan",)
    assert (back.u_start_m, back.u_step_m) == (12.5, 0.05)
    assert np.allclose(back.v_m, v, atol=1e-9)
    assert np.array_equal(np.isnan(back.z_m), np.isnan(z))
    assert np.nanmax(np.abs(back.z_m - z) - digits * np.abs(z), initial=0.0) <= least
    # Steps of 0.05 m along headings of 5 digits at worst; the closing position of the header holds the rest.
    assert np.nanmax(np.abs(back.xyz() - grid.xyz()), initial=0.0) < (1e-8 if encoding in {"KDBI", "LDFI"} else 2e-3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("$ROAD_CRG  ", "$ROAD_CRG_FILE\nother.crg\n$\n$ROAD_CRG ", "only refers to the data file 'other.crg'"),
        ("$ROAD_CRG  ", "$ROAD_CRG_MODS\nscale_z_grid = 2\n$\n$ROAD_CRG ", r"changes the grid .scale_z_grid = 2."),
        ("$ROAD_CRG  ", "$ROAD_CRG_MODS\nrefpoint_x = 0\n$\n$ROAD_CRG ", r"changes the grid .refpoint_x = 0."),
        ("#:LRFI", "#:KRFI", "encoding is KRFI; expected LRFI or LDFI or KRBI or KDBI"),
        ("#:LRFI", "", "encoding is not stated"),
        ("LINE_INCREMENT =  0.50", "LINE_INCREMENT = -0.50", "in steps of -0.5"),
        ("LINE_INCREMENT =  0.50", "LINE_INCREMENT = half", "holds no number"),
        ("LINE_INCREMENT =  0.50", "LINE_INCREMENT = 0.5\nREFERENCE_LINE_END_U = 1e99", "holds no number below"),
        ("LINE_INCREMENT =  0.50", "LINE_INCREMENT = 0.5\nREFERENCE_LINE_END_U = 2", "10 rows, the header's end of u"),
        ("LINE_INCREMENT =  0.50", "LINE_INCREMENT = 0.5\nREFERENCE_LINE_END_U = 9", "10 rows, the header claims 19"),
        ("phi,rad", "phi,deg", "'reference line phi,deg' is in 'deg'; expected rad"),
        ("long section 3,m", "long section 4,m", "not numbered"),
        ("long section 3,m", "long section at v = 1,m", "by position and by number"),
        ("D:long section 2,m", "", "not numbered"),
        ("\n$$!", "\n$!", r"no line that begins '\$\$'"),
        ("\n 0.0220000", "\n *missing*", "phi of the reference line is no number"),
        ("\n 0.0220000", "\n 0.0x20000", "record 6: a number cannot be read"),
        ("\n 0.0220000", "\n0.0220000 ", None),
        ("$KD_DEFINiTION", "$KD_OTHER", r"no block \$KD_DEFINITION"),
    ],
)
def test_refusals(tmp_path: Path, old: str, new: str, message: str | None) -> None:
    assert old in SPECIFICATION
    path = written(tmp_path, SPECIFICATION.replace(old, new, 1))
    if message is None:
        assert np.ravel(read_crg(path).phi_rad)[5] == 0.022
        return
    with pytest.raises(FormatError, match=message):
        read_crg(path)


def test_harmless_blocks_are_passed_over(tmp_path: Path) -> None:
    extra = "$ROAD_CRG_OPTS\nborder_mode_u = 0\n$\n$ROAD_CRG_MODS\ngrid_nan_mode = 0\nscale_slope = 1\n$\n$ROAD_CRG "
    assert read_crg(written(tmp_path, SPECIFICATION.replace("$ROAD_CRG  ", extra, 1))).rows == 10


def test_a_line_that_turns_back_is_refused() -> None:
    grid = CurvedRegularGrid(np.array([0.0, 1.0]), np.zeros((3, 2)), 1.0, phi_rad=np.array([0.0, math.pi]))
    with pytest.raises(FormatError, match="turns back"):
        grid.xyz()


# --- the log -----------------------------------------------------------------------------------------


def test_nodes_become_points(tmp_path: Path) -> None:
    path = written(tmp_path, SPECIFICATION)
    assert format_of(path).name == "opencrg"
    log = read("opencrg", path, OPTIONS, **LOCAL)
    assert len(log) == 29  # 30 nodes, one hole
    assert set(log.epochs.tolist()) == {EPOCH_GPS_NS}
    xyz = read_crg(path).xyz().reshape(-1, 3)
    kept = xyz[np.isfinite(xyz[:, 2])]
    assert np.array_equal(np.column_stack([log[f"{a}_m"] for a in "xyz"]), kept)
    assert (log.attributes["crs"], log.attributes["height"], log.attributes["columns"]) == ("local", "ellipsoidal", 3)
    assert log.rejects == []


def test_what_the_format_does_not_say_has_to_be_stated(tmp_path: Path) -> None:
    path = written(tmp_path, SPECIFICATION)
    with pytest.raises(ConfigError, match="CRS of the log's positions is not stated"):
        read("opencrg", path, OPTIONS)
    with pytest.raises(CrsError, match="no projected CRS in metres"):
        read("opencrg", path, OPTIONS, crs="EPSG:4979")
    with pytest.raises(CrsError, match="no projected CRS in metres"):
        read("opencrg", path, OPTIONS, crs="EPSG:2229")  # US survey feet
    with pytest.raises(TimeSystemError, match=r"options\.epoch = 2026"):
        read("opencrg", path, **LOCAL)
    with pytest.raises(TimeSystemError, match="no time zone"):
        read("opencrg", path, {"epoch": dt.datetime(2026, 5, 4)}, **LOCAL)
    with pytest.raises(ConfigError, match="OpenCRG holds no stamps"):
        read("opencrg", path, OPTIONS, clock=Clock(TimeSystem.GPS), **LOCAL)


def test_a_damaged_height_costs_its_node(tmp_path: Path) -> None:
    path = written(tmp_path, SPECIFICATION.replace("-0.0111111 0.0222222", "-0.01x1111 0.0222222"))
    log = read("opencrg", path, OPTIONS, **LOCAL)
    assert len(log) == 28
    assert [(r.record, r.records) for r in log.rejects] == [(7, 1)]
    rows = [[float(k), 1.0] for k in range(30)]
    rows[12][0], rows[13][1] = math.inf, 1e30
    data = binary("KRBI", rows)
    log = read("opencrg", written(tmp_path, data), OPTIONS, **LOCAL)
    assert len(log) == 58
    start = data.index(b"$$$$\n") + 5
    assert [(r.record, r.records, r.offset) for r in log.rejects] == [(12, 2, start + 12 * 8)]


def test_a_cut_off_file_keeps_its_rows(tmp_path: Path) -> None:
    rows = [[float(k), 1.0, 2.0] for k in range(40)]
    data = binary("KRBI", rows, "REFERENCE_LINE_INCREMENT = 1\nREFERENCE_LINE_END_U = 39")
    start = data.index(b"$$$$\n") + 5
    log = read("opencrg", written(tmp_path, data[: start + 25 * 12 + 7]), OPTIONS, **LOCAL)
    assert len(log) == 75
    assert [(r.record, r.offset) for r in log.rejects] == [(25, start + 25 * 12), (25, start + 25 * 12 + 7)]
    assert "cut off" in log.rejects[0].reason
    assert "missing from here on (15)" in log.rejects[1].reason
    text = SPECIFICATION[: SPECIFICATION.index("-0.0111111 0.0222222") + 14]
    log = read("opencrg", written(tmp_path, text), OPTIONS, **LOCAL)
    assert log.rejected == 1


def test_a_line_lost_in_the_middle_is_not_read_as_heights(tmp_path: Path) -> None:
    """Rows of two lines: without its second line a row would take the first line of the next."""
    names = "".join(f"D:long section {k},m\n" for k in range(1, 11))
    head = f"$ROAD_CRG\n$\n$KD_DEFINITION\n#:LRFI\n{names}$\n$$$$\n"
    lines = [line for _ in range(6) for line in ("".join(f"{k:10.4f}" for k in range(8)), f"{8:10.4f}{9:10.4f}")]
    del lines[5]
    log = read("opencrg", written(tmp_path, head + "\n".join(lines) + "\n"), OPTIONS, **LOCAL)
    assert len(log) == 20
    assert [(r.record, r.records) for r in log.rejects] == [(2, 4)]


def test_chunks_stay_small(tmp_path: Path) -> None:
    z = np.random.default_rng(1).uniform(-0.1, 0.1, (3000, 500)).astype(np.float32).astype(np.float64)
    grid = CurvedRegularGrid(0.01 * np.arange(500), z, 0.01, phi_rad=np.linspace(0, 1, 2999).astype(np.float32))
    path = tmp_path / "a.crg"
    write_crg(grid, path)
    log = read("opencrg", path, OPTIONS, **LOCAL)  # checks the size of every chunk
    assert len(log.rows) > 10
    assert np.array_equal(log["z_m"], z.ravel())


def test_rows_of_nothing_at_the_end_are_fill_unless_counted(tmp_path: Path) -> None:
    rows = [[1.0, 2.0], [3.0, 4.0], [math.nan, math.nan]]
    assert read_crg(written(tmp_path, binary("KRBI", rows))).rows == 2
    counted = "REFERENCE_LINE_INCREMENT = 1\nREFERENCE_LINE_END_U = 2"
    assert read_crg(written(tmp_path, binary("KRBI", rows, counted))).rows == 3


def test_other_files_are_not_taken_for_opencrg(tmp_path: Path) -> None:
    assert not format_named("opencrg").sniff(written(tmp_path, "the block $ROAD_CRG is described here", "a.txt"))
    assert not format_named("opencrg").sniff(tmp_path / "missing")
    assert not format_named("opencrg").sniff(tmp_path)


def sample(encoding: Any, folder: Path) -> Path:
    """A small sound file with all channels."""
    rng = np.random.default_rng(4)
    grid = CurvedRegularGrid(
        0.1 * np.arange(11), rng.uniform(-1, 1, (12, 11)), 0.1, phi_rad=rng.uniform(0, 0.1, 11),
        slope=rng.uniform(0, 0.1, 11), banking=rng.uniform(0, 0.1, 12),
    )  # fmt: skip
    write_crg(grid, folder / "sample.crg", encoding)
    return folder / "sample.crg"
