"""A small sound log of every format and form, to be damaged: made by the makers of the readers' own tests."""

from __future__ import annotations

import bz2
import datetime as dt
import functools
import gzip
import io
import lzma
import random
import re
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet as pq
import pytest

from roadscan.core.crs import MapFrame
from roadscan.core.gpstime import Clock, TimeSystem
from roadscan.core.rig import Sensor
from roadscan.formats.clouds.e57_file import page_checksums
from roadscan.ingest.reading.text_table import LINE_BYTES_MAX
from tests.formats import (
    hesai_files,
    robosense_files,
    ros_files,
    test_argoverse,
    test_carmen,
    test_control_lines,
    test_control_vector,
    test_encoder_csv,
    test_gnss_csv,
    test_gpx,
    test_hesai,
    test_images,
    test_imu_csv,
    test_kitti,
    test_las,
    test_livox_lvx,
    test_nmea,
    test_novatel,
    test_office_text,
    test_opencrg,
    test_ouster_bag,
    test_pcd,
    test_picture_control,
    test_picture_points,
    test_ply,
    test_ppk,
    test_psi,
    test_road_lines,
    test_rtklib_pos,
    test_scans,
    test_sick_lms,
    test_smrmsg,
    test_ubx,
    test_velodyne_models,
    test_velodyne_pcap,
)
from tests.formats.e57_files import PAGE, PAYLOAD, small_e57
from tests.formats.nmea_files import Fix, sentences
from tests.formats.ouster_files import ouster
from tests.formats.sick_files import encode_scans, encode_telegram, write_telegrams
from tests.fuzz import bag_samples
from tests.fuzz.mutations import Change, Inside
from tests.fuzz.pose_samples import (
    control_csv,
    level_feather,
    level_parquet,
    pose_feather,
    pose_parquet,
    returns_parquet,
)

GPS = Clock(TimeSystem.GPS)
WEEK = Clock(TimeSystem.GPS_WEEK, week=2405)
RECORDS = 12

Spans = list[tuple[int, int]]


@dataclass(frozen=True)
class Sample:
    """A sound log, and what is known of its bytes."""

    format: str
    form: str
    make: Callable[[Path], Path]
    """Writes the log into an empty folder; returns its path."""
    options: dict[str, Any] = field(default_factory=dict)
    stated: dict[str, Any] = field(default_factory=dict)
    damaged: tuple[str, ...] = ()
    """Names (patterns) of the files to damage, relative to the folder; the log itself where none is given."""
    text: bool = False
    fields: tuple[int, ...] = ()
    """Bytes at which counts, lengths and offsets of a binary header stand."""
    inside: Inside | None = None
    spans: Callable[[bytes], Spans] | None = None
    """First byte, and the one behind the last, of each record of the sound file, where damage in one record must
    leave all others as they are."""
    held: Callable[[bytes], int | None] | None = None
    """Records that a damaged file holds, where its bytes tell: all have to be read or rejected."""
    reads: int = 1
    """Rows a record, for `held`."""
    share: float = 1.0
    """How many of the format's damaged files are of this form, relative to others."""
    native: bool = False
    """Read through a process of its own: slow."""

    @property
    def name(self) -> str:
        return f"{self.format}/{self.form}"


# --- packed and checksummed content -----------------------------------------------------------------


def packed_by(pack: Callable[[bytes], bytes], unpack: Callable[[bytes], bytes]) -> Inside:
    """Change the content, or two members one behind the other."""

    def inside(data: bytes, rng: random.Random, change: Change) -> bytes:
        content = change(unpack(data), rng)
        if rng.random() < 0.1:
            cut = rng.randrange(len(content) + 1)
            return pack(content[:cut]) + pack(content[cut:])
        return pack(content)

    return inside


GZIP = packed_by(functools.partial(gzip.compress, compresslevel=1, mtime=0), gzip.decompress)
BZIP2 = packed_by(bz2.compress, bz2.decompress)
XZ = packed_by(functools.partial(lzma.compress, preset=0), lzma.decompress)


def nmea_inside(data: bytes, rng: random.Random, change: Change) -> bytes:
    """Sentences changed, with checksums that fit."""

    def sound(match: re.Match[bytes]) -> bytes:
        return b"$%b*%02X" % (match[1], functools.reduce(lambda a, b: a ^ b, match[1], 0))

    return re.sub(rb"\$([^*$\r\n]*)\*[0-9A-Fa-f]{2}", sound, change(data, rng))


def novatel_inside(data: bytes, rng: random.Random, change: Change) -> bytes:
    """Messages changed, with checksums that fit."""

    def sound(match: re.Match[bytes]) -> bytes:
        return b"#%b*%08x" % (match[1], test_novatel.crc32(match[1]))

    return re.sub(rb"#([^*#\r\n]*)\*[0-9A-Fa-f]{8}", sound, change(data, rng))


def telegram_inside(data: bytes, rng: random.Random, change: Change) -> bytes:
    """One telegram's payload changed, with a CRC that fits."""
    found = [m.start() for m in re.finditer(rb"\x02\x80", data)]
    at = rng.choice(found)
    size = int.from_bytes(data[at + 2 : at + 4], "little")
    payload = data[at + 4 : at + 4 + size]
    return data[:at] + encode_telegram(change(payload, rng)[:1400] or b"\xb0") + data[at + 6 + size :]


def page_inside(data: bytes, rng: random.Random, change: Change) -> bytes:
    """An E57 file changed below its pages' checksums, which fit."""
    logical = change(b"".join(data[at : at + PAYLOAD] for at in range(0, len(data), PAGE)), rng)
    logical += bytes(-len(logical) % PAYLOAD)
    size = len(logical) // PAYLOAD * PAGE
    if len(logical) > 24 and rng.random() < 0.7:
        logical = logical[:16] + struct.pack("<Q", size) + logical[24:]
    pages = np.frombuffer(logical, dtype=np.uint8).reshape(-1, PAYLOAD)
    sums = page_checksums(pages).astype(">u4").view(np.uint8).reshape(-1, 4)
    return np.concatenate([pages, sums], axis=1).tobytes()


def zip_inside(data: bytes, rng: random.Random, change: Change) -> bytes:
    """One member of an archive changed."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    members[name] = change(members[name], rng)
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return sink.getvalue()


def psi_inside(data: bytes, rng: random.Random, change: Change) -> bytes:
    """The zipped ranges changed before they are packed."""
    ranges = zlib.compress(change(test_psi.RANGES.astype("<u2").tobytes(), rng))
    image = test_psi.IMAGE.tobytes()
    return test_psi.handmade(ranges, image, o106=("<B", 1))


# --- records -----------------------------------------------------------------------------------------


def every(size: int, first: int = 0, count: int | None = None) -> Callable[[bytes], Spans]:
    """Records of one size, from byte `first` on."""

    def spans(data: bytes) -> Spans:
        number = (len(data) - first) // size if count is None else count
        return [(first + k * size, first + (k + 1) * size) for k in range(number)]

    return spans


def lines_from(first: int) -> Callable[[bytes], Spans]:
    """Lines without their ends, but for the first ones."""

    def spans(data: bytes) -> Spans:
        return [m.span() for m in re.finditer(rb"[^\r\n]+", data)][first:]

    return spans


def wholes_of(size: int) -> Callable[[bytes], int]:
    """Records of one size, the torn last one too."""
    return lambda data: -(-len(data) // size)


def lines_of_table(data: bytes) -> int | None:
    """Lines behind the line of names that are neither blank nor a comment; None with a line so long that it may be
    rejected whatever it is.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\n" not in data:  # lines end with a carriage return alone
        data = data.replace(b"\r", b"\n")
    at = 0
    for line in data.splitlines(keepends=True):
        at += len(line)
        if line.strip() and not line.strip().startswith(b"#"):
            break
    lines = data[at:].split(b"\n")
    if max(map(len, lines)) > LINE_BYTES_MAX:
        return None
    return sum(1 for line in lines if line not in {b"", b"\r"} and (line[:1] != b"#" or b"\r" in line[:-1]))


# --- makers ------------------------------------------------------------------------------------------


def file(name: str, content: Callable[[], bytes] | bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content())
        return folder / name

    return make


def sbet() -> bytes:
    rows = (
        [1000.0 + k, 0.9 + 1e-7 * k, 0.2, 100.0 + k, *[0.1] * 3, 0.01 * k, 0.02, 0.5 + 0.1 * k, *[0.1] * 7]
        for k in range(RECORDS)
    )
    return b"".join(struct.pack("<17d", *row) for row in rows)


def sbet_with_accuracy(folder: Path) -> Path:
    (folder / "acc.out").write_bytes(smrmsg())
    return file("a.sbet", sbet)(folder)


def smrmsg() -> bytes:
    return test_smrmsg.packed([test_smrmsg.record(999.5 + k, north=0.01 + 0.001 * k) for k in range(RECORDS + 2)])


def table(names: str, row: Callable[[int], str], end: str = "\n") -> bytes:
    return end.join([names, *(row(k) for k in range(RECORDS)), ""]).encode()


def trajectory_csv() -> bytes:
    names = "time_s,latitude_deg,longitude_deg,height_m,roll_deg,pitch_deg,heading_deg,sigma_north_m"
    return table(names, lambda k: f"{1_400_000_000 + k}.5,50.0000{k:02d},10.0,{100 + k},1,2,{3 * k},0.02")


def trajectory_utc() -> bytes:
    names = "time_utc;latitude_deg;longitude_deg;height_m;roll_deg;pitch_deg;heading_deg"
    return table(names, lambda k: f"2026-05-04T09:30:{k:02d}.25Z;50.0000{k:02d};10.0;{100 + k};1;2;{3 * k}", "\r\n")


def pose_matrices() -> bytes:
    names = "time_s,r11,r12,r13,t1,r21,r22,r23,t2,r31,r32,r33,t3"
    return table(names, lambda k: f"{1_400_000_000 + k},1,0,0,{k},0,1,0,2,0,0,1,3")


def pose_lines() -> bytes:
    return b"".join(b"%d.25 %d 2 3 0 0 0 1\n" % (1_400_000_000 + k, k) for k in range(RECORDS))


def kitti_poses(folder: Path) -> Path:
    (folder / "07.txt").write_text("".join(f"1 0 0 {k} 0 1 0 2 0 0 1 {k}\n" for k in range(RECORDS)))
    (folder / "times.txt").write_text("".join(f"{1_400_000_000 + k}.5\n" for k in range(RECORDS)))
    return folder / "07.txt"


def euroc_poses() -> bytes:
    names = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    return table(names, lambda k: f"{1_400_000_000 + k}000000000,{k},2,3,1,0,0,0")


def grid_poses() -> bytes:
    return table("time_s,x,y,z,qx,qy,qz,qw", lambda k: f"{1_400_000_000 + k},{571600 + k}.5,5539000.5,150,0,0,0,1")


def control_dms() -> bytes:
    return table("name,latitude,longitude,height_m", lambda k: f"P{k},52°31'{k:02d}.37N,13 24 02.5,{30 + k}")


def pospac() -> bytes:
    names = "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,wz,wy,wx"
    return table(names, lambda k: f"{1_628_184_886_500 + k},571600.{k},5539000.5,150,0,0,0,0.1,0.2,0.3,0,0,0")


def encoder_wheels() -> bytes:
    return table("time_s,left_ticks,right_ticks", lambda k: f"{1_400_000_000 + k}.5,{7 * k},{8 * k}")


def nmea() -> bytes:
    start = test_nmea.at("2026-05-04T23:59:54")
    fixes = [Fix(start + k * 10**9, 50.0 + 1e-5 * k, 10.0, 100.0, 45.0, "fixed", 12, 0.7) for k in range(RECORDS)]
    return (
        "".join(sentences(fix) for fix in fixes).encode()
        + "".join(sentences(fix, test_nmea.KINDS) for fix in test_nmea.drive(3)).encode()
    )


def carmen() -> bytes:
    lines = ["# CARMEN Logfile", "PARAM robot_frontlaser_offset 0.3 host 0", *(test_carmen.plain(k) for k in range(6))]
    return "\n".join([*lines, ""]).encode()


def carmen_raw() -> bytes:
    lines = [test_carmen.raw("RAWLASER1", k, " ".join(f"{1 + i / 100:.3f}" for i in range(181)), "0") for k in range(4)]
    return "\n".join(["PARAM laser_front_laser_resolution 1.0 host 0", *lines, ""]).encode()


def sick(*, stamped: bool) -> Callable[[Path], Path]:
    return lambda folder: test_sick_lms.sample(folder / "a.log", stamped=stamped)


def sick_with_table(folder: Path) -> Path:
    write_telegrams(folder / "a.log", encode_scans(test_sick_lms.scans(6), "mm"), None)
    (folder / "stamps.csv").write_text("stamp\n" + "".join(f"{1_400_000_000 + k}.5\n" for k in range(6)))
    return folder / "a.log"


def pcap(*, dual: bool = False, sentence: bool = True, **form: Any) -> Callable[[Path], Path]:
    packet = {"mode": test_velodyne_pcap.DUAL} if dual else {}

    def make(folder: Path) -> Path:
        packets = test_velodyne_pcap.drive(RECORDS, **packet)
        if sentence:
            position = test_velodyne_pcap.position_packet(
                1_000_500, test_velodyne_pcap.HOUR_9 + dt.timedelta(seconds=1)
            )
            packets.insert(3, (packets[3][0], test_velodyne_pcap.frame(position, 8308)))
        return test_velodyne_pcap.capture(folder / "a.pcap", packets, **form)

    return make


def las(name: str, point_format: int) -> Callable[[Path], Path]:
    version = "1.4" if point_format >= 6 else "1.2"
    return lambda folder: test_las.cloud(folder / name, version=version, point_format=point_format, n=60)


def kitti(folder: Path) -> Path:
    sweeps = {k: (test_kitti.POINTS + np.float32([k, 0, 0, 0])).tobytes() for k in range(3)}
    return test_kitti.log_folder(folder / "drive", sweeps, test_kitti.STAMPS)


def argoverse(folder: Path) -> Path:
    for k in range(3):
        test_argoverse.write_sweep(folder / "sensors" / "lidar", test_argoverse.STAMP + k * 10**8)
    return folder / "sensors" / "lidar"


def argoverse_plain(folder: Path) -> Path:
    path = folder / f"{test_argoverse.STAMP}.feather"
    columns = pa.table(dict(test_argoverse.SMALL))
    pyarrow.feather.write_feather(columns, str(path), compression="uncompressed")
    return path


def scans(write: Callable[[pa.Table, Path], None]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write(test_scans.profiles().slice(0, 60), folder / "a.table")
        return folder / "a.table"

    return make


def plain_parquet(rows: pa.Table, path: Path) -> None:
    pq.write_table(rows, path, row_group_size=15, compression="none", use_dictionary=False)


def psi_folder(folder: Path) -> Path:
    for k in range(3):
        test_psi.written(folder, test_psi.serial(k, 20 * k), f"{k}.psi")
    return folder


def images(folder: Path) -> Path:
    log = folder / "cam"
    log.mkdir()
    kinds = {
        ".jpg": {"format": "JPEG"},
        ".png": {"format": "PNG"},
        ".tif": {"format": "TIFF", "compression": "tiff_deflate"},
    }
    lines = ["file,time_s"]
    for k, (ending, how) in enumerate(kinds.items()):
        (log / f"img_{k}{ending}").write_bytes(test_images.written(**how)()[:])
        lines.append(f"img_{k}{ending},{test_images.T0 + k}.25")
    (log / "stamps.csv").write_text("\n".join([*lines, ""]))
    return log


def video(name: str, codec: str) -> Callable[[Path], Path]:
    return lambda folder: test_images.video_of(folder / name, codec, count=5)


def vector(frame: Callable[[], Any], name: str) -> Callable[[Path], Path]:
    """A vector layer, written once: GDAL is slow."""

    def make(folder: Path) -> Path:
        for part, content in _layer_files(frame, name).items():
            (folder / part).write_bytes(content)
        return folder / name

    return make


_LAYERS: dict[tuple[str, str], dict[str, bytes]] = {}


def _layer_files(frame: Callable[[], Any], name: str) -> dict[str, bytes]:
    key = (frame.__qualname__, name)
    if key not in _LAYERS:
        import tempfile

        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            frame().to_file(Path(folder) / name)
            _LAYERS[key] = {p.name: p.read_bytes() for p in Path(folder).iterdir()}
    return _LAYERS[key]


def control_layer() -> Any:
    return test_control_vector.layer()


def control_degrees() -> Any:
    return test_control_vector.layer().to_crs("EPSG:4326")


def surveyed_lines() -> Any:
    return test_control_lines.layer()


def roads() -> Any:
    return test_road_lines.tiger()


def roads_degrees() -> Any:
    return test_road_lines.tiger().to_crs("EPSG:4326")


def roads_zip(folder: Path) -> Path:
    path = test_road_lines.zipped(folder)
    shutil.rmtree(folder / "inner")
    return path


# --- all ---------------------------------------------------------------------------------------------

_POSES = {"clock": GPS, "crs": "local"}
_IMU: dict[str, Any] = test_imu_csv.STATED
_UTM32 = {"crs": "EPSG:25832", "height": "ellipsoidal", "map": MapFrame(crs="EPSG:25832")}
_DEGREES = {"crs": "EPSG:4979", "map": MapFrame(crs="EPSG:32632")}
_CLOUD = {"clock": Clock(TimeSystem.GPS_ADJUSTED), "crs": "local"}
_LAS_FIELDS = (24, 94, 96, 100, 104, 105, 107, 111, 115, 119, 131, 139, 155, 163, 179, 187, 227, 235, 243, 247, 255)
_PSI_FIELDS = (
    37,
    38,
    58,
    78,
    79,
    80,
    84,
    88,
    92,
    96,
    97,
    105,
    106,
    107,
    111,
    115,
    119,
    123,
    127,
    128,
    132,
    136,
    141,
    149,
)
_PCAP_FIELDS = (0, 16, 20, 24, 28, 32, 36, 40, 52, 54, 56, 60, 74, 76, 78, 80, 82, 84)
_E57_FIELDS = (8, 12, 16, 24, 32, 40, 48, 56, 64, 72, 80, 81, 82, 84, 86, 88, 90)
_VIDEO = {"end": test_images.T0}


def all_samples() -> list[Sample]:
    """Every form of every format."""
    return [s for part in (_poses(), _tables(), _lidar(), _packets(), _clouds(), _others(), _bags()) for s in part]


def samples_of(name: str) -> list[Sample]:
    """The forms of one format."""
    return [sample for sample in all_samples() if sample.format == name]


def _poses() -> Iterator[Sample]:
    geographic = {"clock": WEEK, "crs": "EPSG:4979"}
    fixed = {"spans": every(136), "held": wholes_of(136)}
    yield Sample("sbet", "plain", file("a.sbet", sbet), {}, geographic, share=2, **fixed)
    yield Sample("sbet", "smrmsg", sbet_with_accuracy, {"accuracy": "acc.out"}, geographic, ("acc.out", "a.sbet"))
    clock = {"clock": WEEK}
    yield Sample("smrmsg", "plain", file("a.out", smrmsg), {}, clock, spans=every(80), held=wholes_of(80))
    yield Sample(
        "smrmsg", "gzip", file("a.out.gz", lambda: gzip.compress(smrmsg(), mtime=0)), {}, clock, inside=GZIP, share=0.5
    )

    stated = {"clock": GPS, "crs": "EPSG:4979"}
    lines: dict[str, Any] = {"text": True, "spans": lines_from(1), "held": lines_of_table}
    yield Sample("trajectory_csv", "plain", file("a.csv", trajectory_csv), {}, stated, share=2, **lines)
    utc = {"clock": Clock(TimeSystem.UNIX_UTC), "crs": "EPSG:4979"}
    yield Sample("trajectory_csv", "utc", file("a.csv", trajectory_utc), {}, utc, **lines)
    packs: dict[str, tuple[Callable[[bytes], bytes], Inside]] = {
        "gz": (gzip.compress, GZIP), "bz2": (bz2.compress, BZIP2), "xz": (lzma.compress, XZ),
    }  # fmt: skip
    for ending, (pack, inside) in packs.items():
        yield Sample(
            "trajectory_csv", ending, file(f"a.csv.{ending}", pack(trajectory_csv())), {}, stated, inside=inside
        )
    axes = {"axes": "flu"}
    ns = {"clock": Clock(TimeSystem.GPS, unit="ns"), "crs": "local"}
    yield Sample("pose_matrices", "plain", file("a.csv", pose_matrices), axes, _POSES, **lines)
    kitti_options = {"axes": "rdf", "frame": "rdf"}
    for form, damaged in (("kitti", "07.txt"), ("kitti times", "times.txt")):
        yield Sample("pose_matrices", form, kitti_poses, kitti_options, _POSES, (damaged,), text=True)
    yield Sample("pose_quaternions", "euroc", file("a.csv", euroc_poses), axes, ns, text=True, spans=lines_from(1))
    utm = {"clock": GPS, "crs": "EPSG:25832", "height": "ellipsoidal"}
    yield Sample("pose_quaternions", "grid", file("a.csv", grid_poses), axes | {"heading": "grid"}, utm, **lines)
    yield Sample("pose_quaternions", "lines", file("a.txt", pose_lines), axes, _POSES, text=True, spans=lines_from(0))
    yield Sample("pose_quaternions", "feather", file("a.feather", pose_feather), axes, _POSES)
    yield Sample("pose_quaternions", "parquet", file("a.parquet", pose_parquet), axes, _POSES)
    yield Sample("trajectory_table", "parquet", file("a.parquet", level_parquet))
    yield Sample("trajectory_table", "feather", file("a.feather", level_feather))
    ms = {"clock": Clock(TimeSystem.GPS, unit="ms"), "crs": "EPSG:25832", "height": "ellipsoidal"}
    yield Sample("pospac", "plain", file("a.csv", pospac), axes, ms, **lines)
    sat = {"crs": "EPSG:4979"}
    offices = {"inertial_explorer": (test_office_text.explorer, sat), "qinertia": (test_office_text.qinertia, sat)}
    yield Sample("grafnav", "plain", file("a.txt", lambda: test_office_text.grafnav().encode()), {}, sat, text=True)
    of_2018 = {"clock": Clock(TimeSystem.GPS_WEEK, week=2013), "crs": "EPSG:4979"}
    offices["pospac_text"] = (test_office_text.pospac, of_2018)
    for name, (write, known) in offices.items():
        text = write(RECORDS).encode()
        spans = lines_from(sum(map(bool, text.splitlines())) - RECORDS)
        yield Sample(name, "plain", file("a.txt", text), {}, known, text=True, spans=spans)
    for name, line, stamp in (
        ("novatel_ins", test_novatel.INSPVAX, "2209,490782.000"),
        ("novatel_ins", test_novatel.INSPVA, "2209,490558.000"),
        ("novatel_bestpos", test_novatel.BESTPOS, "2404,603797.000"),
    ):
        log = test_novatel.drive(line, stamp, RECORDS)
        form = line[1:].split(",")[0]
        yield Sample(name, form, file("a.log", log), {}, sat, text=True, spans=lines_from(0), inside=novatel_inside)
    yield Sample(
        "rtklib_pos", "plain", file("a.pos", test_rtklib_pos.sample), {}, sat, text=True, spans=lines_from(2), share=2
    )
    yield Sample(
        "rtklib_pos", "gz", file("a.pos.gz", lambda: gzip.compress(test_rtklib_pos.sample())), {}, sat, inside=GZIP
    )
    ppk: dict[str, Any] = {"options": test_ppk.sample_options(), "native": True}
    yield Sample("ppk", "rover", _with_rtklib(test_ppk.sample), text=True, **ppk)
    yield Sample("ppk", "base", _with_rtklib(test_ppk.sample), text=True, damaged=("base.obs", "brdc.nav"), **ppk)
    yield Sample("ppk", "ubx", _with_rtklib(test_ppk.sample_ubx), **ppk)
    gpx = {"height": "ellipsoidal"}
    yield Sample("gpx", "plain", file("a.gpx", test_gpx.track(RECORDS).encode()), {"quality": "single"}, gpx, text=True)
    names = "time,latitude_deg,longitude_deg,height_m,quality,satellites,sigma_north_m"
    row = "2025-05-04T09:00:0{i}Z,{lat},{lon},{h},fix,12,0.01"
    positions = functools.partial(test_gnss_csv.table, names=names, row=row)
    yield Sample("gnss_csv", "plain", positions, {}, {"height": "ellipsoidal", "crs": "EPSG:4979"}, text=True)
    yield Sample("ubx", "plain", file("a.ubx", test_ubx.sample), {}, sat, spans=every(100))
    for untimed in ("before", "after"):
        yield Sample("nmea", untimed, file("a.nmea", nmea), {"untimed": untimed}, sat, text=True, inside=nmea_inside)


def _with_rtklib(make: Callable[[Path], Path]) -> Callable[[Path], Path]:
    """The maker of a log that RTKLIB reads; the test is skipped where it is absent."""

    def made(folder: Path) -> Path:
        if shutil.which("rnx2rtkp") is None:
            pytest.skip("RTKLIB is not on PATH: apt-get install rtklib")
        return make(folder)

    return made


def _tables() -> Iterator[Sample]:
    lines: dict[str, Any] = {"text": True, "spans": lines_from(1), "held": lines_of_table}
    imu = functools.partial(test_imu_csv.sample, RECORDS)
    yield Sample("imu_csv", "plain", file("a.csv", imu), {}, _IMU, share=2, **lines)
    yield Sample("imu_csv", "gz", file("a.csv.gz", lambda: gzip.compress(imu())), {}, _IMU, inside=GZIP)
    encoder = functools.partial(test_encoder_csv.sample, RECORDS)
    stated = test_encoder_csv.STATED
    yield Sample("encoder_csv", "total", file("a.csv", encoder), {"record": "total"}, stated, **lines)
    counter = {"record": "total", "counter_bits": 16}
    yield Sample("encoder_csv", "counter", file("a.csv", encoder), counter, stated, text=True, held=lines_of_table)
    yield Sample(
        "encoder_csv",
        "increment",
        file("a.csv", encoder),
        {"record": "increment"},
        stated,
        text=True,
        held=lines_of_table,
    )
    yield Sample("control_csv", "plain", file("a.csv", control_csv), {}, _UTM32, **lines)
    dms = {"height": "ellipsoidal", "crs": "EPSG:4979", "map": MapFrame(crs="EPSG:32633")}
    yield Sample("control_csv", "dms", file("a.csv", control_dms), {"role": "gcp"}, dms, **lines)
    odm, opensfm = test_picture_control.ODM.encode(), test_picture_control.opensfm(RECORDS)
    yield Sample("odm_gcp", "plain", file("gcp_list.txt", odm), {"role": "gcp"}, test_picture_control.UTM32, text=True)
    places = functools.partial(test_picture_points.sample, RECORDS)
    yield Sample("picture_points_csv", "plain", file("a.csv", places), {}, {}, **lines)
    yield Sample("odm_picture_points", "plain", file("gcp_list.txt", odm), {}, {}, text=True)
    yield Sample("opensfm_picture_points", "plain", file("a.json", opensfm), {"size_px": [400, 300]}, {}, text=True)
    yield Sample("opensfm_gcp", "plain", file("a.json", opensfm), {"role": "gcp"}, dms, text=True)
    yield Sample("control_vector", "geojson", vector(control_degrees, "a.geojson"), {}, _DEGREES, text=True)
    yield Sample("control_vector", "gpkg", vector(control_layer, "a.gpkg"), {}, _UTM32)
    yield Sample("control_lines", "gpkg", vector(surveyed_lines, "a.gpkg"), {}, _UTM32)
    yield Sample("control_lines", "text", file("a.csv", test_control_lines.TEXT.encode()), {}, _UTM32, text=True)
    lane = {"map": MapFrame(crs="EPSG:26917")}
    yield Sample("road_lines", "geojson", vector(roads_degrees, "a.geojson"), {}, lane, text=True)
    yield Sample("road_lines", "gpkg", vector(roads, "a.gpkg"), {}, lane)
    yield Sample("road_lines", "shp", vector(roads, "a.shp"), {}, lane, ("a.shp", "a.shx", "a.dbf", "a.prj"))
    yield Sample("road_lines", "zip", roads_zip, {}, lane, inside=zip_inside)


def pcap_of(product: int, *, dual: bool = False) -> Callable[[Path], Path]:
    mode = test_velodyne_pcap.DUAL if dual else test_velodyne_pcap.STRONGEST
    packets = test_velodyne_models.drive(product, RECORDS, mode=mode)
    return lambda folder: test_velodyne_pcap.capture(folder / "a.pcap", packets)


def hesai(model: str) -> Callable[[Path], Path]:
    return lambda folder: test_hesai.log_of(folder, model, hesai_files.turning(model, RECORDS))


def bag_scans(kind: str, message: str, payloads: list[bytes]) -> Callable[[Path], Path]:
    """A bag with three packets a message, stamped by the driver."""
    pandar = message.startswith("pandar")
    begin_ns = test_velodyne_pcap.posix_ns(hesai_files.MOMENT) + 10**9

    def packet(k: int) -> dict[str, Any]:
        data = np.frombuffer(payloads[k].ljust(1500 if pandar else 1206, b"\0"), np.uint8)
        more = {"size": len(payloads[k])} if pandar else {}
        return {"stamp": ros_files.stamp(begin_ns + k * 400_000), "data": data, **more}

    rows = [
        (begin_ns + k * 400_000, {"packets": [packet(k + j) for j in range(3)]}) for k in range(0, len(payloads), 3)
    ]

    def make(folder: Path) -> Path:
        hesai_files.angle_file(folder / "angles.csv", *test_hesai.angles_of("PandarXT-16"))
        return ros_files.write_bag(folder / "bag", kind, {"/packets": (message, rows)})

    return make


def _packets() -> Iterator[Sample]:
    """Lidars whose packets are in a capture or in a bag."""
    hour = {"options": {"hour": 9}, "stated": {"clock": test_velodyne_pcap.CLOCK}, "fields": _PCAP_FIELDS}
    yield Sample("velodyne_pcap", "vlp_32c", pcap_of(test_velodyne_models.VLP_32C), **hour)
    yield Sample("velodyne_pcap", "vls_128", pcap_of(test_velodyne_models.VLS_128), **hour)
    yield Sample("velodyne_pcap", "vls_128_dual", pcap_of(test_velodyne_models.VLS_128, dual=True), **hour)
    for model in hesai_files.SHAPES:
        stated = {"model": model} if model in ("Pandar128", "OT128") else {}
        options = {"angles": "angles.csv", **stated}
        size = 16 + 42 + len(hesai_files.turning(model, 1)[0])
        spans = every(size, 24) if model in ("QT128", "PandarXT-16") else None
        yield Sample("hesai_pcap", model.lower(), hesai(model), options, {}, fields=_PCAP_FIELDS, spans=spans)
    for model in ("RS-LiDAR-16", "Helios", "Ruby"):
        sent, info = robosense_files.turning(model, RECORDS), robosense_files.difop(model)
        named = {"model": model} if model == "Ruby" else {}
        robosense = functools.partial(robosense_files.log_of, payloads=sent, info=info)
        yield Sample("robosense_pcap", model.lower(), robosense, named, {}, fields=_PCAP_FIELDS)
    yield Sample("robosense_pcap", "m1", robosense_files.frames, {}, {}, fields=_PCAP_FIELDS)
    for kind, log in (("ros1", "bag.bag"), ("mcap", "bag/*.mcap")):
        yield Sample("robosense_scans", kind, functools.partial(robosense_files.bag, kind=kind), {}, {}, (log,))
    velodyne = [content[42:] for _, content in test_velodyne_models.drive(test_velodyne_models.VLP_32C, RECORDS)]
    xt = hesai_files.turning("PandarXT-16", RECORDS)
    for kind, log in (("ros1", "bag.bag"), ("mcap", "bag/*.mcap"), ("sqlite", "bag/*.db3")):
        pandar = bag_scans(kind, "pandar_msgs/msg/PandarScan", xt)
        angles = {"angles": "angles.csv" if kind == "ros1" else "../angles.csv"}
        yield Sample("hesai_scans", kind, pandar, angles, {}, (log,))
        driver = bag_scans(kind, "velodyne_msgs/msg/VelodyneScan", velodyne)
        yield Sample("velodyne_scans", kind, driver, {"hour": "capture"}, {}, (log,))


def _lidar() -> Iterator[Sample]:
    yield Sample("velodyne_pcap", "sentence", pcap(), {}, {}, fields=_PCAP_FIELDS)
    hour = {"hour": 9}
    stated = {"clock": test_velodyne_pcap.CLOCK}
    size = 16 + 42 + 1206
    plain = pcap(sentence=False)
    yield Sample("velodyne_pcap", "hour", plain, hour, stated, fields=_PCAP_FIELDS, spans=every(size, 24))
    yield Sample(
        "velodyne_pcap",
        "dual",
        pcap(dual=True, sentence=False, order=">", nanoseconds=True),
        hour,
        stated,
        fields=_PCAP_FIELDS,
    )
    metadata, count = {"metadata": "a.json"}, {"clock": Clock(TimeSystem.FREE)}
    yield Sample("ouster_pcap", "legacy", ouster("LEGACY"), metadata, count, fields=_PCAP_FIELDS)
    dual = ouster("RNG19_RFL8_SIG16_NIR16_DUAL", checksum=True)
    whole = 16 + 42 + 64 + 4 * (12 + 16 * 16)
    yield Sample("ouster_pcap", "dual", dual, metadata, count, fields=_PCAP_FIELDS, spans=every(whole, 24))
    low = ouster("RNG15_RFL8_NIR8")
    yield Sample("ouster_pcap", "metadata", low, metadata, count, ("a.json",), text=True)
    imu = count | {"sensor": Sensor(kind="imu")}
    yield Sample("ouster_imu", "packets", ouster("LEGACY", imu=True), metadata, imu, fields=_PCAP_FIELDS)
    yield Sample("ouster_imu", "metadata", ouster("LEGACY", imu=True), metadata, imu, ("a.json",), text=True)
    for kind in ("ros1", "mcap", "sqlite"):
        bag = functools.partial(test_ouster_bag.small_bag, kind)
        parts = () if kind == "ros1" else ("bag/bag*",)
        yield Sample("ouster_bag", kind, bag, {}, count, parts)
        yield Sample("ouster_bag_imu", kind, functools.partial(bag, imu=True), {}, imu, parts)
    yield Sample("livox_lvx", "lvx2", test_livox_lvx.sample, {}, count)
    yield Sample("livox_lvx", "lvx", test_livox_lvx.old_sample, {}, count)
    by_rate = test_sick_lms.BY_RATE
    one = len(encode_scans(test_sick_lms.scans(1), "mm").tobytes())
    scan_clock = {"clock": GPS}
    yield Sample("sick_lms", "rate", sick(stamped=False), by_rate, scan_clock, spans=every(one), inside=telegram_inside)
    yield Sample(
        "sick_lms",
        "stamped",
        sick(stamped=True),
        {"stamped": True},
        {"clock": test_sick_lms.GPS_NS},
        inside=telegram_inside,
    )
    with_table = {"stamps": "stamps.csv"}
    yield Sample("sick_lms", "table", sick_with_table, with_table, scan_clock, ("stamps.csv", "a.log"), text=True)
    yield Sample("carmen", "plain", file("a.clf", carmen), {}, scan_clock, text=True)
    step = {"range_step_m": 0.01, "message": "FLASER"}
    yield Sample("carmen", "step", file("a.clf", carmen), step, scan_clock, text=True, spans=lines_from(2))
    yield Sample("carmen", "raw", file("a.clf", carmen_raw), {}, scan_clock, text=True)
    yield Sample("carmen", "bz2", file("a.clf.bz2", lambda: bz2.compress(carmen())), {}, scan_clock, inside=BZIP2)
    yield Sample("kitti", "sweeps", kitti, {}, {}, ("**/*.bin",))
    yield Sample("kitti", "stamps", kitti, {}, {}, ("**/timestamps.txt",), text=True)
    unix = {"clock": test_argoverse.CLOCK}
    yield Sample("argoverse", "folder", argoverse, {}, unix, ("**/*.feather",))
    yield Sample("argoverse", "plain", argoverse_plain, {}, unix)
    yield Sample("returns_table", "parquet", file("a.parquet", returns_parquet))
    yield Sample("scans", "parquet", scans(test_scans.write_parquet))
    yield Sample("scans", "plain", scans(plain_parquet))
    yield Sample("scans", "arrow", scans(test_scans.write_arrow))
    yield Sample("scans", "zstd", scans(test_scans.write_compressed))


def _bags() -> Iterator[Sample]:
    """One topic a format; the containers are shared out, and those of point clouds are all."""
    stated: dict[str, dict[str, Any]] = {
        "ros_points": bag_samples.LIDAR,
        "ros_livox": bag_samples.LIDAR,
        "ros_imu": {"clock": bag_samples.UTC, "sensor": Sensor(kind="imu")},
        "ros_gnss": {"clock": bag_samples.UTC, "crs": "EPSG:4979"},
        "ros_poses": {"clock": bag_samples.UTC, "crs": "local"},
        "ros_nmea": {"crs": "EPSG:4979"},
    }
    options = {"ros_poses": {"axes": "flu"}}
    for name in bag_samples.TOPICS:
        kinds = bag_samples.CONTAINERS if name == "ros_points" else ("ros1", "sqlite", "mcap")
        for kind in kinds:
            yield Sample(name, kind, bag_samples.bag(name, kind), options.get(name, {}), stated[name])


def _clouds() -> Iterator[Sample]:
    for coding in test_pcd.CODINGS:
        make = functools.partial(test_pcd.sample, coding)
        text = coding is test_pcd.CODINGS[0]
        yield Sample("pcd", coding.value, make, {}, {"clock": test_pcd.FREE}, text=text)
        scan = functools.partial(test_pcd.scan, coding)
        local = {"crs": "local", "height": "ellipsoidal"}
        yield Sample("pcd_cloud", coding.value, scan, test_pcd.CLOUD, local, text=text)
    cloud = {"clock": test_las.ADJUSTED, "height": "ellipsoidal"}
    for point_format in (3, 7):
        yield Sample("las", f"las{point_format}", las("a.las", point_format), {}, cloud, fields=_LAS_FIELDS)
        yield Sample(
            "las", f"laz{point_format}", las("a.laz", point_format), {}, cloud, fields=_LAS_FIELDS, native=True
        )
    yield Sample(
        "e57", "checked", file("a.e57", small_e57), {}, {"crs": "local"}, fields=_E57_FIELDS, inside=page_inside
    )
    yield Sample(
        "e57",
        "unchecked",
        file("a.e57", small_e57),
        {"check_pages": False},
        {"crs": "local"},
        fields=_E57_FIELDS,
        inside=page_inside,
    )
    for coding in test_ply.CODINGS:
        for lists in (False, True):
            content = test_ply.small_ply(coding, lists)
            form = coding + ("+lists" if lists else "")
            yield Sample("ply", form, file("a.ply", content), {"unit": "metre"}, _CLOUD, text=coding == "ascii")
            if not lists and coding != "ascii":
                first = content.index(b"end_header") + 11 + 13 + 5
                spans = every(29, first, 30)
                yield Sample(
                    "ply", form + " records", file("a.ply", content), {"unit": "metre"}, _CLOUD, spans=spans, share=0.1
                )
    crg = {"epoch": test_opencrg.EPOCH}
    for encoding in ("KRBI", "KDBI", "LRFI", "LDFI"):
        make = functools.partial(test_opencrg.sample, encoding)
        yield Sample("opencrg", encoding, make, crg, test_opencrg.LOCAL, text=encoding[0] == "L")


def _others() -> Iterator[Sample]:
    unix = {"clock": test_psi.UNIX_MS}
    stated = test_psi.STATED
    for codec, form in enumerate(("raw", "zip", "jpeg", "png")):
        inside = psi_inside if codec == 1 else None
        make = file("a.psi", functools.partial(test_psi.sample, codec))
        yield Sample("psi", form, make, stated, unix, fields=_PSI_FIELDS, inside=inside)
    yield Sample("psi", "folder", psi_folder, stated, unix, ("*.psi",), fields=_PSI_FIELDS)
    camera = test_images.STATED
    table_option = {"stamps": "stamps.csv"}
    yield Sample("images", "pictures", images, table_option, camera, ("cam/img_*",))
    yield Sample("images", "stamps", images, table_option, camera, ("cam/stamps.csv",), text=True)
    for name, codec in (("a.avi", "MJPG"), ("a.mkv", "MJPG"), ("a.mp4", "mp4v")):
        yield Sample("images", name[2:], video(name, codec), _VIDEO, camera, native=True)
