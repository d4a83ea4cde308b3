"""PSI containers: bytes at the layout's offsets, round trips, refusals, damage."""

from __future__ import annotations

import gzip
import io
import json
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from roadscan.core.errors import ConfigError, FormatError, TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.formats.scanners.psi import Psi, PsiStatement, statement_text
from roadscan.formats.scanners.psi_container import PsiContainer, PsiHeader, write_psi
from roadscan.ingest.reading.format import format_named, format_of
from tests.formats.psi_files import read_psi
from tests.formats.readings import read

ROWS, COLUMNS = 6, 10
GPS_NS = 1_300_000_000 * 10**9
UNIX_MS = Clock(TimeSystem.UNIX_UTC, unit="ms")
STATED = {
    "length_unit": "mm",
    "values": "range",
    "first_row": "start",
    "first_column": "left",
    "speed_unit": "km/h",
}
RANGES = np.random.default_rng(1).integers(1, 65_536, (ROWS, COLUMNS)).astype(np.uint16)
RANGES[2, 3] = 0
IMAGE = np.random.default_rng(2).integers(0, 256, (ROWS, COLUMNS)).astype(np.uint8)


def handmade(
    ranges: bytes | None = None,
    image: bytes | None = None,
    metadata: bytes = b"",
    shape: tuple[int, int] = (ROWS, COLUMNS),
    shape2d: tuple[int, int] | None = None,
    **at: tuple[str, Any],
) -> bytes:
    """A file by the offsets of the layout, independent of the writer; `at` overwrites fields: o119=("<i", 7)."""
    ranges = RANGES.astype("<u2").tobytes() if ranges is None else ranges
    image = IMAGE.tobytes() if image is None else image
    head = bytearray(545)
    for offset, code, value in [
        (0, "<3s", b"psi"), (3, "<5s", b"1.02"), (8, "<9s", b"2.10.3"), (17, "<3s", b"OK"), (20, "<13s", b"I-35"),
        (33, "<f", 271.5), (37, "<B", 2), (38, "<I", 17), (42, "<d", -97.0625), (50, "<d", 36.125), (58, "<f", 1234.5),
        (62, "<9s", b"20260504"), (71, "<7s", b"093000"),
        (78, "<B", 0), (79, "<B", 0), (80, "<f", 5.0), (84, "<f", 1.0), (88, "<i", (shape2d or shape)[1]),
        (92, "<i", (shape2d or shape)[0]), (96, "<B", 8), (97, "<I", len(image)), (101, "<f", 100.0),
        (105, "<B", 0), (106, "<B", 0), (107, "<f", 5.0), (111, "<f", 1.0), (115, "<f", 0.0625), (119, "<i", shape[1]),
        (123, "<i", shape[0]), (127, "<B", 16), (128, "<I", len(ranges)), (132, "<f", 100.0), (136, "<B", 0),
        (137, "<f", 1500.0), (141, "<I", len(metadata)), (145, "<f", 72.0), (149, "<q", 1_777_887_000_250),
        (157, "<33s", b"Van 3"), (190, "<33s", b"Ann"), (223, "<33s", b"Roads"), (256, "<33s", b"LCMS"),
    ]:  # fmt: skip
        struct.pack_into(code, head, offset, value)
    for name, (code, value) in at.items():
        struct.pack_into(code, head, int(name[1:]), value)
    return bytes(head) + image + ranges + metadata + b"@@@@"


def written(folder: Path, data: bytes, name: str = "a.psi") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def lists(log: Any, column: str, columns: int = COLUMNS) -> np.ndarray:
    return log.table.column(column).combine_chunks().flatten().to_numpy().reshape(-1, columns)


# --- the container -----------------------------------------------------------------------------------


def test_fields_at_the_offsets_of_the_layout(tmp_path: Path) -> None:
    file = read_psi(written(tmp_path, handmade(metadata=b"as surveyed")))
    assert file.header == PsiHeader(
        version="1.02", software_version="2.10.3", state="OK", route="I-35", heading_deg=271.5, lane=2, file_serial=17,
        longitude_deg=-97.0625, latitude_deg=36.125, dmi=1234.5, date="20260504", time="093000", longitudinal2d=5.0,
        transverse2d=1.0, quality2d=100.0, longitudinal3d=5.0, transverse3d=1.0, vertical3d=0.0625, quality3d=100.0,
        registration=0, reference_range=1500.0, speed=72.0, timestamp=1_777_887_000_250, vehicle="Van 3",
        operator="Ann", contractor="Roads", sensor="LCMS",
    )  # fmt: skip
    assert np.array_equal(file.surface3d, RANGES)
    assert np.array_equal(file.image2d, IMAGE)
    assert file.metadata == "as surveyed"


def test_the_writer_puts_fields_where_the_layout_says(tmp_path: Path) -> None:
    path = written(tmp_path, handmade(metadata=b"as surveyed"))
    write_psi(read_psi(path), tmp_path / "b.psi", codec2d="raw", codec3d="raw")
    assert (tmp_path / "b.psi").read_bytes() == path.read_bytes()


def zlib_of(data: bytes) -> bytes:
    return zlib.compress(data)


def pkzip_of(data: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", data)
    return out.getvalue()


@pytest.mark.parametrize("pack", [zlib_of, gzip.compress, pkzip_of])
def test_every_reading_of_zip(tmp_path: Path, pack: Callable[[bytes], bytes]) -> None:
    data = handmade(pack(RANGES.astype("<u2").tobytes()), pack(IMAGE.tobytes()), o79=("<B", 1), o106=("<B", 1))
    file = read_psi(written(tmp_path, data))
    assert np.array_equal(file.surface3d, RANGES)
    assert np.array_equal(file.image2d, IMAGE)


@pytest.mark.parametrize("codec", [2, 3])
def test_jpeg_and_png(tmp_path: Path, codec: int) -> None:
    smooth = np.tile(np.linspace(0, 250, 64).astype(np.uint8), (48, 1))
    encoded = cv2.imencode(".jpg" if codec == 2 else ".png", smooth)[1].tobytes()
    file = read_psi(written(tmp_path, handmade(image=encoded, shape2d=smooth.shape, o79=("<B", codec))))
    assert file.image2d is not None
    assert np.abs(file.image2d.astype(int) - smooth).max() <= (3 if codec == 2 else 0)


def test_storage_by_columns(tmp_path: Path) -> None:
    data = handmade(RANGES.T.astype("<u2").tobytes(), IMAGE.T.tobytes(), o78=("<B", 1), o105=("<B", 1))
    file = read_psi(written(tmp_path, data))
    assert np.array_equal(file.surface3d, RANGES)
    assert np.array_equal(file.image2d, IMAGE)


texts = st.text(st.characters(codec="latin-1", exclude_characters="\0", exclude_categories=["Zs", "Cc"]), max_size=8)
singles = st.floats(-1e9, 1e9, width=32)


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    header=st.builds(
        PsiHeader, route=texts, vehicle=texts, sensor=texts, heading_deg=singles, lane=st.integers(0, 255),
        file_serial=st.integers(0, 2**32 - 1), longitude_deg=st.floats(-180, 180), dmi=singles, vertical3d=singles,
        reference_range=singles, speed=singles, timestamp=st.integers(-(2**63), 2**63 - 1),
    ),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    has=st.tuples(st.booleans(), st.booleans()),
    codecs=st.tuples(st.sampled_from(["raw", "zip", "png"]), st.sampled_from(["raw", "zip"])),
    order=st.sampled_from(["row", "column"]),
    metadata=st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_round_trip(
    tmp_path: Path, header: PsiHeader, shape: tuple[int, int], has: tuple[bool, bool], codecs: Any, order: Any,
    metadata: str, seed: int,
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, shape).astype(np.uint8) if has[0] else None
    surface = rng.integers(0, 65_536, shape[::-1]).astype(np.uint16) if has[1] else None
    path = tmp_path / "a.psi"
    write_psi(PsiContainer(header, image, surface, metadata), path, codec2d=codecs[0], codec3d=codecs[1], order=order)
    back = read_psi(path)
    assert back.header == header
    assert back.metadata == metadata
    for one, other in ((back.image2d, image), (back.surface3d, surface)):
        assert (one is None) == (other is None)
        assert one is None or (one.dtype == other.dtype and np.array_equal(one, other))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"o106": ("<B", 2)}, "stored as OpenCRG, which"),
        ({"o106": ("<B", 3)}, "stored as zipped OpenCRG, which"),
        ({"o106": ("<B", 4)}, "stored as JPEG 2000, which"),
        ({"o106": ("<B", 9)}, "3D image has the codec 9"),
        ({"o79": ("<B", 4)}, "2D image has the codec 4; expected 0 .raw., 1 .zip., 2 .jpeg., 3 .png."),
        ({"o105": ("<B", 2)}, "3D image has the storage order 2"),
        ({"o127": ("<B", 8)}, "3D image has 8 bits a pixel; expected 16"),
        ({"o119": ("<i", -1)}, "claims -1 × 6 pixels"),
        ({"o123": ("<i", 2**31 - 1)}, "claims 10 × 2147483647 pixels in 120 bytes"),
        ({"o128": ("<I", 2**32 - 1)}, "the header claims 4,294,967,9"),
        ({"o0": ("<3s", b"PSI")}, "does not begin with 'psi'"),
    ],
)
def test_refusals(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_psi(written(tmp_path, handmade(**change)))


def test_a_file_cut_off_and_a_wrong_trailer(tmp_path: Path) -> None:
    data = handmade()
    for end in (0, 8, 300, 545, len(data) - 1):
        with pytest.raises(FormatError):
            read_psi(written(tmp_path, data[:end]))
    with pytest.raises(FormatError, match="the trailer is b'@@@x'"):
        read_psi(written(tmp_path, data[:-1] + b"x"))
    with pytest.raises(FormatError, match=r"claims 729 bytes, the file has 730"):
        read_psi(written(tmp_path, data + b"x"))


@pytest.mark.slow
def test_a_bomb_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    edge = 20_000
    bomb = zlib.compress(bytes(2 * edge * edge), 9)  # 800 MB of nothing in 0.8 MB
    data = handmade(bomb, shape=(edge, edge), shape2d=(ROWS, COLUMNS), o106=("<B", 1))
    path = written(tmp_path, data)
    tracemalloc.start()
    with pytest.raises(FormatError, match=r"at most .* 64 MB and 100 times the stored bytes"):
        read_psi(path)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


@pytest.mark.parametrize("size", [(ROWS, COLUMNS + 1), (ROWS, COLUMNS - 1)])
@pytest.mark.parametrize("pack", [zlib_of, pkzip_of])
def test_more_or_less_than_claimed(tmp_path: Path, size: tuple[int, int], pack: Callable[[bytes], bytes]) -> None:
    data = handmade(pack(bytes(2 * size[0] * size[1])), o106=("<B", 1))
    with pytest.raises(FormatError, match="it unpacks to"):
        read_psi(written(tmp_path, data))


def test_images_that_are_not_what_the_header_says(tmp_path: Path) -> None:
    def refused(image: np.ndarray | bytes, codec: int, message: str) -> None:
        encoded = (
            image if isinstance(image, bytes) else cv2.imencode(".jpg" if codec == 2 else ".png", image)[1].tobytes()
        )
        with pytest.raises(FormatError, match=message):
            read_psi(written(tmp_path, handmade(image=encoded, o79=("<B", codec))))

    large = np.zeros((300, 400), np.uint8)
    refused(large, 2, "it has 400 × 300 pixels, the header says 10 × 6")
    refused(large, 3, "it has 400 × 300 pixels, the header says 10 × 6")
    refused(np.zeros((ROWS, COLUMNS, 3), np.uint8), 3, "colour type 2 of 8 bits")
    refused(np.zeros((ROWS, COLUMNS), np.uint16), 3, "colour type 0 of 16 bits")
    refused(b"\xff\xd8 nothing", 2, "the end of the JPEG is missing")
    refused(b"no image", 3, "it is no PNG")
    sound = cv2.imencode(".jpg", IMAGE)[1].tobytes()
    refused(sound[:-2], 2, "the end of the JPEG is missing")
    refused(sound[:-2] + b"\xff\xda" * 40 + b"\xff\xd9", 2, "more than 32 scans")
    png = bytearray(cv2.imencode(".png", IMAGE)[1].tobytes())
    png[-20] ^= 1
    refused(bytes(png), 3, "a chunk of the PNG is damaged")


def test_texts_too_long_are_not_cut(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="route 'Interstate 35 northbound' does not fit"):
        write_psi(PsiContainer(PsiHeader(route="Interstate 35 northbound")), tmp_path / "a.psi")
    with pytest.raises(FormatError, match=r"3D image is uint8"):
        write_psi(PsiContainer(surface3d=IMAGE), tmp_path / "a.psi")  # type: ignore[arg-type]


# --- the log -----------------------------------------------------------------------------------------


def test_profiles_of_a_file(tmp_path: Path) -> None:
    path = written(tmp_path, handmade())
    assert format_of(path).name == "psi"
    log = read("psi", path, STATED, clock=UNIX_MS)
    # 2026-05-04T09:30:00.250 UTC: 18 leap seconds between GPS and UTC; 5 mm at 72 km/h are 250 µs.
    start = (1_777_887_000_250 - 315_964_800_000 + 18_000) * 10**6
    assert log.epochs.tolist() == [start + 250_000 * k for k in range(ROWS)]
    assert np.array_equal(lists(log, "range"), RANGES)
    assert np.array_equal(lists(log, "intensity"), IMAGE)
    assert log.attributes["scan_geometry"] == {
        "kind": "cartesian", "readings": COLUMNS, "first": pytest.approx(-0.0045), "step": pytest.approx(0.001),
        "range_offset_m": pytest.approx(1.5), "range_step_m": 0.0625e-3, "reading_period_ns": 0.0,
    }  # fmt: skip
    assert (log.rows[0].first_offset, log.rows[0].record_bytes) == (545 + ROWS * COLUMNS, 2 * COLUMNS)
    assert log.rejects == []


def test_heights_become_ranges_that_grow_downwards(tmp_path: Path) -> None:
    log = read("psi", written(tmp_path, handmade()), {**STATED, "values": "height"}, clock=UNIX_MS)
    geometry = log.attributes["scan_geometry"]
    stored = lists(log, "range").astype(float)
    seen = RANGES != 0
    assert np.array_equal(stored == 0, ~seen)
    ranges_m = geometry["range_offset_m"] + geometry["range_step_m"] * stored
    assert np.allclose(ranges_m[seen], (1.5 - 0.0625e-3 * RANGES.astype(float))[seen], atol=1e-9)


def test_directions_and_invalid_codes(tmp_path: Path) -> None:
    code = int(RANGES[4, 4])
    options = {**STATED, "first_row": "end", "first_column": "right", "no_return": [code], "first_m": 0.25}
    log = read("psi", written(tmp_path, handmade()), options, clock=UNIX_MS)
    expected = np.where(code == RANGES, 0, RANGES)
    assert np.array_equal(lists(log, "range"), expected[::-1])
    assert np.array_equal(lists(log, "intensity"), IMAGE[::-1])
    geometry = log.attributes["scan_geometry"]
    assert (geometry["first"], geometry["step"]) == (0.25, pytest.approx(-0.001))


def test_the_stamp_is_that_of_the_row_passed_first(tmp_path: Path) -> None:
    """Whichever end of the piece row 0 is, and with the epochs of the metadata too."""
    stored = written(tmp_path, handmade())
    forth, back = (read("psi", stored, {**STATED, "first_row": end}, clock=UNIX_MS) for end in ("start", "end"))
    assert np.array_equal(lists(back, "range"), lists(forth, "range")[::-1])
    assert np.array_equal(back.epochs, forth.epochs)
    since = np.array([0, 1, 5, 9, 14, 20])
    statement = PsiStatement(length_unit="mm", values="range", first_row="end", first_column="left", timestamp="gps_ns")
    path = written(tmp_path, handmade(metadata=statement_text(statement, since).encode(), o149=("<q", GPS_NS)))
    log = read("psi", path)
    assert np.array_equal(log.epochs, GPS_NS + since)
    assert np.array_equal(lists(log, "range"), RANGES[::-1])
    assert "first row in order of travel" in Psi.time


def test_what_the_draft_leaves_open_has_to_be_stated(tmp_path: Path) -> None:
    path = written(tmp_path, handmade())
    with pytest.raises(ConfigError, match=r"does not state length_unit, values, first_row, first_column.*options = \{"):
        read("psi", path, clock=UNIX_MS)
    for name in STATED:
        with pytest.raises(ConfigError, match=f"does not state {name}"):
            read("psi", path, {k: v for k, v in STATED.items() if k != name}, clock=UNIX_MS)
    with pytest.raises(TimeSystemError, match="time system is not stated"):
        read("psi", path, STATED)
    with pytest.raises(ConfigError, match="furlong"):
        read("psi", path, {**STATED, "length_unit": "furlong"}, clock=UNIX_MS)


def test_speed_zero_asks_for_a_speed(tmp_path: Path) -> None:
    path = written(tmp_path, handmade(o145=("<f", 0.0)))
    log = read("psi", path, STATED, clock=UNIX_MS)
    assert (len(log), log.rejected) == (0, ROWS)
    assert "state options.speed_m_per_s" in log.rejects[0].reason
    stated = {k: v for k, v in STATED.items() if k != "speed_unit"}
    log = read("psi", path, {**stated, "speed_m_per_s": 10.0}, clock=UNIX_MS)
    assert np.diff(log.epochs).tolist() == [500_000] * (ROWS - 1)


def test_metadata_state_everything(tmp_path: Path) -> None:
    statement = PsiStatement(
        length_unit="mm", values="range", first_row="start", first_column="left", first_m=-1.0, timestamp="gps_ns"
    )
    since = np.array([0, 1, 5, 9, 14, 20])
    text = statement_text(statement, since).encode()
    path = written(tmp_path, handmade(metadata=text, o149=("<q", GPS_NS), o145=("<f", 0.0)))
    log = read("psi", path)
    assert log.epochs.tolist() == (GPS_NS + since).tolist()
    assert log.attributes["scan_geometry"]["first"] == -1.0
    with pytest.raises(ConfigError, match=r"options\.length_unit is 'm', the file's metadata state 'mm'"):
        read("psi", path, {"length_unit": "m"})
    with pytest.raises(ConfigError, match="GPS time already"):
        read("psi", path, clock=UNIX_MS)


@pytest.mark.parametrize("epochs", ["[0,1]", "[0,1,2,3,4,-5]", "[0,1,2,3,4,1e3]", '"x"', "[0,1,2,3,4,9e999]"])
def test_row_epochs_that_do_not_fit(tmp_path: Path, epochs: str) -> None:
    text = '{"roadscan_psi":' + json.dumps({**STATED, "timestamp": "gps_ns"}) + ',"row_epochs_ns":' + epochs + "}"
    log = read("psi", written(tmp_path, handmade(metadata=text.encode(), o149=("<q", GPS_NS))))
    assert (len(log), log.rejected) == (0, ROWS)
    assert "row epochs" in log.rejects[0].reason


@pytest.mark.parametrize(
    ("shape2d", "steps", "expected"),
    [
        ((2 * ROWS, 3 * COLUMNS), (2.5, 1 / 3), (slice(1, None, 2), slice(1, None, 3))),
        ((ROWS, COLUMNS), (5.0, 1.0), (slice(None), slice(None))),
    ],
)
def test_images_of_a_multiple_resolution(tmp_path: Path, shape2d: Any, steps: Any, expected: Any) -> None:
    image = np.random.default_rng(3).integers(0, 256, shape2d).astype(np.uint8)
    data = handmade(image=image.tobytes(), shape2d=shape2d, o80=("<f", steps[0]), o84=("<f", steps[1]))
    log = read("psi", written(tmp_path, data), STATED, clock=UNIX_MS)
    assert np.array_equal(lists(log, "intensity"), image[expected])


def test_a_coarser_image_is_repeated(tmp_path: Path) -> None:
    image = np.arange(ROWS // 2 * (COLUMNS // 5), dtype=np.uint8).reshape(ROWS // 2, COLUMNS // 5)
    data = handmade(image=image.tobytes(), shape2d=image.shape, o80=("<f", 10.0), o84=("<f", 5.0))
    log = read("psi", written(tmp_path, data), STATED, clock=UNIX_MS)
    assert np.array_equal(lists(log, "intensity"), image.repeat(2, axis=0).repeat(5, axis=1))


@pytest.mark.parametrize(
    ("shape2d", "change"),
    [
        ((ROWS, COLUMNS), {"o136": ("<B", 1)}),
        ((ROWS + 1, COLUMNS), {}),
        ((2 * ROWS, COLUMNS), {}),  # twice the pixels at the same size: other ground
        ((ROWS, COLUMNS), {"o84": ("<f", 0.0)}),
    ],
)
def test_an_image_on_another_grid_is_listed_and_the_ranges_kept(
    tmp_path: Path, shape2d: tuple[int, int], change: dict[str, Any]
) -> None:
    data = handmade(image=bytes(shape2d[0] * shape2d[1]), shape2d=shape2d, **change)
    log = read("psi", written(tmp_path, data), STATED, clock=UNIX_MS)
    assert np.array_equal(lists(log, "range"), RANGES)
    assert log.table.column("intensity").null_count == ROWS
    assert [(r.offset, r.records) for r in log.rejects] == [(545, 1)]
    assert log.rejects[0].reason.startswith("image on another grid")


def test_a_damaged_image_costs_itself(tmp_path: Path) -> None:
    data = handmade(image=b"\xff\xd8 no JPEG \xff\xd9", o79=("<B", 2))
    log = read("psi", written(tmp_path, data), STATED, clock=UNIX_MS)
    assert np.array_equal(lists(log, "range"), RANGES)
    assert [r.offset for r in log.rejects] == [545]
    assert "2D image cannot be decoded" in log.rejects[0].reason


def serial(number: int, stamp_ms: int, **change: Any) -> bytes:
    return handmade(o38=("<I", number), o149=("<q", 1_777_887_000_000 + stamp_ms), **change)


def test_a_folder_is_read_by_serial_numbers(tmp_path: Path) -> None:
    written(tmp_path, serial(2, 20), "a.psi")
    written(tmp_path, serial(1, 0), "b.PSI")
    (tmp_path / "readme.txt").write_text("no PSI")
    assert format_of(tmp_path).name == "psi"
    log = read("psi", tmp_path, STATED, clock=UNIX_MS)
    assert [r.file for r in log.rows] == ["b.PSI", "a.psi"]
    assert (np.diff(log.epochs) > 0).all()


def test_a_damaged_file_of_a_folder_costs_itself(tmp_path: Path) -> None:
    packed = zlib.compress(RANGES.astype("<u2").tobytes())
    for k in range(6):
        written(tmp_path, serial(k, 20 * k, ranges=packed, o106=("<B", 1)), f"{k}.psi")
    broken = bytearray((tmp_path / "1.psi").read_bytes())
    broken[545 + ROWS * COLUMNS + 20] ^= 0xFF
    (tmp_path / "1.psi").write_bytes(broken)
    (tmp_path / "2.psi").write_bytes((tmp_path / "2.psi").read_bytes()[:-9])
    written(tmp_path, serial(3, 20 * 3, ranges=packed, o106=("<B", 1), o111=("<f", 2.0)), "3.psi")
    written(tmp_path, serial(4, 10**9, ranges=packed, o106=("<B", 1)), "4.psi")
    log = read("psi", tmp_path, STATED, clock=UNIX_MS)
    assert [r.file for r in log.rows] == ["0.psi", "5.psi"]
    listed = {r.file: (r.record, r.offset, r.records) for r in log.rejects}
    at = (0, 545 + ROWS * COLUMNS, ROWS)
    assert listed == {"1.psi": at, "2.psi": (0, 0, 1), "3.psi": at, "4.psi": at}
    reasons = {r.file: r.reason for r in log.rejects}
    assert "3D image cannot be decoded" in reasons["1.psi"]
    assert "scan geometry" in reasons["3.psi"]
    assert "time stamp leaps" in reasons["4.psi"]


def test_chunks_stay_small(tmp_path: Path) -> None:
    wide = np.random.default_rng(5).integers(0, 65_536, (3000, 2000)).astype(np.uint16)
    data = handmade(wide.tobytes(), b"", shape=wide.shape, shape2d=(0, 0))
    log = read("psi", written(tmp_path, data), STATED, clock=UNIX_MS)  # checks the size of every chunk
    assert len(log.rows) > 1
    assert [r.first_record for r in log.rows][1] * 4000 + 545 == log.rows[1].first_offset
    assert np.array_equal(lists(log, "range", 2000), wide)


def test_other_files_are_not_taken_for_psi(tmp_path: Path) -> None:
    assert not format_named("psi").sniff(written(tmp_path, b"psi and more", "a.psi"))
    assert not format_named("psi").sniff(tmp_path / "missing")


def sample(codec: int) -> bytes:
    """A small sound file: raw, zip, JPEG or PNG image (0–3) beside raw or zipped ranges."""
    smooth = np.tile(np.linspace(0, 250, COLUMNS).astype(np.uint8), (ROWS, 1))
    image = {
        0: smooth.tobytes(),
        1: zlib.compress(smooth.tobytes()),
        2: cv2.imencode(".jpg", smooth)[1].tobytes(),
        3: cv2.imencode(".png", smooth)[1].tobytes(),
    }[codec]
    ranges = RANGES.astype("<u2").tobytes()
    return handmade(zlib.compress(ranges) if codec else ranges, image, o79=("<B", codec), o106=("<B", min(codec, 1)))
