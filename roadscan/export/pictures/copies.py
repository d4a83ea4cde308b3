"""Copies of pictures with their places in them: EXIF and XMP, undistorted, and with people and vehicles hidden."""

from __future__ import annotations

import csv
import datetime as dt
import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from roadscan.compute.array_types import Float64, UInt8
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.extras import cv2, need
from roadscan.core.frames import ENU_FROM_NED
from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.export.export import Exported, published
from roadscan.measuring.measure import posed_pictures
from roadscan.measuring.poses import PicturePoses, yaw_pitch_roll_deg
from roadscan.measuring.work import picked_poses
from roadscan.pictures.lens import Lens, matrix_of
from roadscan.poses.trajectory import world_from_ned
from roadscan.privacy.hider import Hider, decoded, encoded, hider_of
from roadscan.run.session import Session
from roadscan.store.codecs.image_files import with_tags

JPEG: Final = (".jpg", ".jpeg")
"""Suffixes of pictures whose bytes are copied."""
_KEY_DIGITS: Final = 6  # Digits of a log's key that tell it from others in names.
_WHOLE_M: Final = 1.0
"""The local frame's origin lies at whole multiples of this on the map."""


@dataclass(frozen=True)
class Choice:
    """Which pictures."""

    run: str | None = None
    camera: str | None = None


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """A topocentric frame (x east, y north, z up; m) near the pictures, without the map's scale and curvature."""

    world: str
    origin_map_m: Float64
    """(3,) easting, northing, height of its origin."""
    origin_world_m: Float64
    local_from_world: Float64
    """(3, 3) rotation."""

    @property
    def lon_lat_height(self) -> Float64 | None:
        """Longitude, latitude (degrees, WGS 84) and ellipsoidal height (m) of the origin; None of a local map."""
        return wgs84(self.world, self.origin_world_m[None])[0] if self.world != LOCAL_WORLD else None

    def points(self, world_m: Float64) -> Float64:
        """Return places (n, 3) of the world frame in this one."""
        return np.asarray((world_m - self.origin_world_m) @ self.local_from_world.T)


def chosen_pictures(session: Session, choice: Choice) -> PicturePoses:
    """Return the poses of the chosen pictures, in order of time.

    Raises
    ------
    ConfigError
        where no picture is of that run and camera.
    """
    poses = posed_pictures(session)
    logs = poses.pictures.logs
    for word, asked, known in (("run", choice.run, {log.run for log in logs}),
                               ("camera", choice.camera, {log.sensor for log in logs})):  # fmt: skip
        if asked is not None and asked not in known:
            raise ConfigError(
                f"no picture with a pose is of {word} '{asked}'{nearest(asked, sorted(known))}",
                expected="one of: " + ", ".join(sorted(known)),
            )
    kept = [
        k
        for k, log in enumerate(poses.pictures.log.tolist())
        if choice.run in (None, logs[log].run) and choice.camera in (None, logs[log].sensor)
    ]
    if not kept:
        raise ConfigError(f"run '{choice.run}' has no picture of '{choice.camera}' with a pose")
    return picked_poses(poses, np.array(kept, np.int64))


def local_frame(poses: PicturePoses) -> LocalFrame:
    """Return a local frame whose origin is the least easting, northing and height of the pictures, in whole metres.

    Raises
    ------
    ConfigError
        where the pictures' trajectories are in different world frames.
    """
    worlds = {poses.pictures.worlds[k] for k in poses.pictures.views.world.tolist()}
    if len(worlds) != 1:
        raise ConfigError(
            f"the pictures' trajectories are in {len(worlds)} frames: {', '.join(sorted(worlds))}",
            expected="pictures in one", change="choose a run",
        )  # fmt: skip
    world = worlds.pop()
    origin_map = np.floor(poses.place_m.min(axis=0) / _WHOLE_M) * _WHOLE_M
    origin = poses.pictures.map.world_from_map(world, origin_map[None])[0]
    turn = ENU_FROM_NED @ world_from_ned(world, origin[None])[0].T
    return LocalFrame(world, origin_map, origin, turn)


def wgs84(world: str, world_m: Float64) -> Float64:
    """Return longitude, latitude (degrees) and ellipsoidal height (n, 3) in WGS 84 of places of a geocentric frame."""
    from pyproj import Transformer

    to_wgs84 = Transformer.from_crs(crs_from_text(world), "EPSG:4978", always_xy=True)
    to_degrees = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    return np.stack(to_degrees.transform(*to_wgs84.transform(*world_m.T)), axis=-1)


def exported_names(poses: PicturePoses) -> tuple[str, ...]:
    """Return the names of pictures in an export, RUN/CAMERA/FILE; copies are JPEG files, so the file ends as these do.

    Where pictures of two logs of one camera would have one name, each has RUN/CAMERA/LOG/FILE, LOG being its log's
    folder with the first digits of its key; pictures of one log that still would have one name also have their epochs.
    """
    pictures = poses.pictures
    names, by_log, by_epoch = [], [], []
    for log, file, epoch in zip(pictures.log.tolist(), pictures.files, pictures.epochs_gps_ns.tolist(), strict=True):
        source = pictures.logs[log]
        folder = f"{source.folder.name}-{source.key[:_KEY_DIGITS]}"
        names.append(_inside(f"{source.run}/{source.sensor}/{file}"))
        by_log.append(_inside(f"{source.run}/{source.sensor}/{folder}/{file}"))
        name = by_log[-1]
        by_epoch.append(name.with_name(f"{name.stem}_{name.suffix[1:]}_{epoch}{name.suffix}"))
    for other in (by_log, by_epoch):
        copies = [str(name.with_suffix(".jpg")).casefold() for name in names]  # as programs that fold case see them
        times = Counter(copies)
        names = [o if times[copy] > 1 else n for n, o, copy in zip(names, other, copies, strict=True)]
    return tuple(str(name if name.suffix.lower() in JPEG else name.with_suffix(".jpg")) for name in names)


def _inside(name: str) -> PurePosixPath:
    """Return a relative path that leads to nothing beside the export."""
    return PurePosixPath(*(part for part in PurePosixPath(name).parts if part != ".."))


_SENSOR_MM: Final = 36.0
"""Width of the sensor that the focal length in millimetres refers to (mm): the rig file states pixels alone, and
FocalPlaneXResolution says how many of them a millimetre has."""
_FILM_MM: Final = math.hypot(36.0, 24.0)  # Diagonal of FocalLengthIn35mmFilm (CIPA DCG-001).
_QUALITY: Final = 95  # Quality of pictures that are encoded anew.
_NADIR_DEG: Final = 90.0
"""Pix4D's pitch is 0 where the camera looks down, DJI's 0 where it looks to the horizon (degrees)."""
_MM_UNIT: Final = 4  # Code of millimetres in FocalPlaneResolutionUnit.


@dataclass(frozen=True)
class CopySettings:
    """What copies are like."""

    exif: bool = True
    undistorted: bool = False
    blurred: bool = False


def export_pictures(
    session: Session,
    out: Path,
    choice: Choice,
    settings: CopySettings,
    report: Callable[[int, int], None] = lambda _a, _b: None,
) -> Exported:
    """Write copies of pictures by their `exported_names`, and ``pictures.csv`` (poses) and ``cameras.json`` (lenses).

    JPEG files that are neither undistorted nor blurred keep their picture's bytes; all others are encoded anew.

    Raises
    ------
    ConfigError
        where `out` holds something, no picture is chosen, or nothing says what is to be blurred.
    """
    if settings.undistorted or settings.blurred:
        need("cv2", "copies of pictures")
    poses = chosen_pictures(session, choice)
    hider, names = hider_of(session) if settings.blurred else None, exported_names(poses)
    notes, rows, files = [], [], []
    with published(out) as folder:
        for k in range(len(poses)):
            report(k, len(poses))
            try:
                name = _copy(poses, k, folder / names[k], settings, hider).relative_to(folder).as_posix()
            except (OSError, ValueError) as error:
                notes.append(f"left out: {names[k]}: {error}")
                continue
            files.append(name)
            rows.append(_row(poses, k, name))
        report(len(poses), len(poses))
        with (folder / "pictures.csv").open("w", encoding="utf-8", newline="") as stream:
            table = csv.DictWriter(stream, list(rows[0]) if rows else ["file"], lineterminator="\n")
            table.writeheader()
            table.writerows(rows)
        cameras = _cameras(poses, settings.undistorted)
        (folder / "cameras.json").write_text(json.dumps(cameras, indent=1, ensure_ascii=False) + "\n")
    if settings.undistorted and any(lens.is_around for lens in poses.pictures.views.lenses):
        notes.append("pictures of 360° have no distortion and are copied as they are")
    return Exported((*(out / name for name in files), out / "pictures.csv", out / "cameras.json"), tuple(notes))


def _copy(poses: PicturePoses, number: int, out: Path, settings: CopySettings, hider: Hider | None) -> Path:
    """Write a copy; return its file."""
    source, lens = poses.pictures.path(number), poses.pictures.views.lens_of(number)
    undistorts = settings.undistorted and not lens.is_around
    content = source.read_bytes()
    if undistorts or hider is not None or source.suffix.lower() not in JPEG:
        picture = decoded(content)
        if hider is not None:
            picture, _ = hider.hide(poses.pictures, number, picture)
        content = encoded(undistorted(picture, lens) if undistorts else picture, _QUALITY)
        out = out.with_suffix(".jpg")
    if settings.exif:
        content = with_tags(content, *tags_of(poses, number, _pinhole(lens) if undistorts else lens))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(content)
    return out


def undistorted(picture: UInt8, lens: Lens) -> UInt8:
    """Return a picture (height, width, 3) as a pinhole of the same focal lengths and principal point sees it."""
    straight = cv2.undistort(np.ascontiguousarray(picture), matrix_of(lens), lens.parameters[4:9])
    return np.asarray(straight, np.uint8)


def _pinhole(lens: Lens) -> Lens:
    values = lens.parameters.copy()
    values[4:9] = 0.0
    return replace(lens, parameters=values)


def tags_of(poses: PicturePoses, number: int, lens: Lens) -> tuple[bytes, bytes]:
    """Return the EXIF structure and the XMP packet of a picture.

    EXIF: place in WGS 84 with the height above the ellipsoid, direction of the optical axis from true north, UTC.
    XMP: the namespace Camera of Pix4D (pitch 0 looks down) and drone-dji (pitch 0 looks to the horizon).
    """
    from PIL import ExifTags, Image

    moment = utc_from_gps_ns(int(poses.pictures.epochs_gps_ns[number])).astimezone(dt.UTC)
    width, height = lens.size_px
    focal_mm = float(lens.parameters[0]) * _SENSOR_MM / width
    exif = Image.Exif()
    base, gps = ExifTags.Base, ExifTags.GPS
    exif[base.Software], exif[base.Model] = "roadscan", poses.pictures.logs[poses.pictures.log[number]].sensor
    shot: dict[int, Any] = {
        base.DateTimeOriginal: moment.strftime("%Y:%m:%d %H:%M:%S"), base.OffsetTimeOriginal: "+00:00",
        base.SubsecTimeOriginal: f"{moment.microsecond:06d}",
    }  # fmt: skip
    if not lens.is_around:
        film = round(float(lens.parameters[0]) / math.hypot(width, height) * _FILM_MM)
        resolution = _rational(width / _SENSOR_MM)
        shot |= {
            base.FocalLength: _rational(focal_mm), base.FocalLengthIn35mmFilm: film,
            base.FocalPlaneXResolution: resolution, base.FocalPlaneYResolution: resolution,
            base.FocalPlaneResolutionUnit: _MM_UNIT,
        }  # fmt: skip
    exif.get_ifd(ExifTags.IFD.Exif).update(shot)
    yaw, pitch, roll = yaw_pitch_roll_deg(poses.ned_from_camera[number][None])[0].tolist()
    world = poses.pictures.worlds[poses.pictures.views.world[number]]
    spread = _spread(poses, number)
    if world != LOCAL_WORLD:
        place = wgs84(world, poses.pictures.views.eye_world_m[number][None])[0].tolist()
        exif.get_ifd(ExifTags.IFD.GPSInfo).update({
            gps.GPSVersionID: b"\x02\x03\x00\x00",
            gps.GPSLatitudeRef: "N" if place[1] >= 0.0 else "S", gps.GPSLatitude: _sexagesimal(place[1]),
            gps.GPSLongitudeRef: "E" if place[0] >= 0.0 else "W", gps.GPSLongitude: _sexagesimal(place[0]),
            gps.GPSAltitudeRef: b"\x00" if place[2] >= 0.0 else b"\x01", gps.GPSAltitude: _rational(abs(place[2])),
            gps.GPSMapDatum: "WGS-84", gps.GPSImgDirectionRef: "T", gps.GPSImgDirection: _rational(yaw),
            gps.GPSDateStamp: moment.strftime("%Y:%m:%d"),
            gps.GPSTimeStamp: (
                _rational(moment.hour, 1), _rational(moment.minute, 1),
                _rational(moment.second + moment.microsecond / 10**6),
            ),
            gps.GPSHPositioningError: _rational(math.hypot(spread["north"], spread["east"])),
        })  # fmt: skip
    return exif.tobytes(), _xmp(lens, (yaw, pitch, roll), spread)


def _xmp(lens: Lens, yaw_pitch_roll: tuple[float, float, float], spread: dict[str, float]) -> bytes:
    """Return an XMP packet (ISO 16684-1) with the orientation, its σ and the lens."""
    yaw, pitch, roll = yaw_pitch_roll
    width, _ = lens.size_px
    pixel_mm = _SENSOR_MM / width
    camera: dict[str, object] = {
        "Yaw": f"{yaw:.6f}", "Pitch": f"{pitch + _NADIR_DEG:.6f}", "Roll": f"{roll:.6f}",
        "IMUYawAccuracy": f"{spread['yaw']:.6f}", "IMUPitchAccuracy": f"{spread['pitch']:.6f}",
        "IMURollAccuracy": f"{spread['roll']:.6f}",
        "GPSXYAccuracy": f"{math.hypot(spread['north'], spread['east']):.4f}", "GPSZAccuracy": f"{spread['down']:.4f}",
        "HorizCS": "EPSG:4326", "VertCS": "ellipsoidal",
    }  # fmt: skip
    if not lens.is_around:
        fx, _, cx, cy, k1, k2, p1, p2, k3 = lens.parameters[:9].tolist()
        camera |= {
            "ModelType": "perspective", "PerspectiveFocalLength": f"{fx * pixel_mm:.9f}",
            "PrincipalPoint": f"{(cx + 0.5) * pixel_mm:.9f},{(cy + 0.5) * pixel_mm:.9f}",
            "PerspectiveDistortion": ",".join(f"{v:.12g}" for v in (k1, k2, k3, p2, p1)),
        }  # fmt: skip
    dji = {"GimbalYawDegree": f"{yaw:+.6f}", "GimbalPitchDegree": f"{pitch:+.6f}", "GimbalRollDegree": f"{roll:+.6f}"}
    values = [f'Camera:{name}="{value}"' for name, value in camera.items()]
    values += [f'drone-dji:{name}="{value}"' for name, value in dji.items()]
    text = (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
        'xmlns:Camera="http://pix4d.com/camera/1.0/" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
        + " ".join(values)
        + '/></rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    )
    return text.encode()


def _spread(poses: PicturePoses, number: int) -> dict[str, float]:
    """Return 1 σ of the place (m) and of the turns about the camera's axes (degrees)."""
    covariance = poses.covariance[number]
    turn = poses.ned_from_camera[number]
    about = np.degrees(np.sqrt(np.diag(turn.T @ covariance[3:, 3:] @ turn)))  # right, down, ahead
    place = np.sqrt(np.diag(covariance[:3, :3]))
    names = ("north", "east", "down", "pitch", "yaw", "roll")
    return dict(zip(names, [*place.tolist(), *about.tolist()], strict=True))


def _row(poses: PicturePoses, number: int, name: str) -> dict[str, Any]:
    """Return a line of ``pictures.csv``."""
    yaw, pitch, roll = yaw_pitch_roll_deg(poses.ned_from_camera[number][None])[0].tolist()
    spread, pictures = _spread(poses, number), poses.pictures
    log = pictures.logs[pictures.log[number]]
    moment = utc_from_gps_ns(int(pictures.epochs_gps_ns[number])).astimezone(dt.UTC)
    place, geographic = poses.place_m[number].tolist(), poses.geographic[number].tolist()
    return {
        "file": name, "run": log.run, "camera": log.sensor, "utc": moment.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        "easting_m": f"{place[0]:.5f}", "northing_m": f"{place[1]:.5f}", "height_m": f"{place[2]:.5f}",
        "longitude_deg": f"{geographic[0]:.10f}", "latitude_deg": f"{geographic[1]:.10f}",
        "ellipsoidal_height_m": f"{geographic[2]:.5f}",
        "yaw_deg": f"{yaw:.6f}", "pitch_deg": f"{pitch:.6f}", "roll_deg": f"{roll:.6f}",
        **{f"sigma_{n}_m": f"{spread[n]:.5f}" for n in ("north", "east", "down")},
        **{f"sigma_{n}_deg": f"{spread[n]:.6f}" for n in ("yaw", "pitch", "roll")},
        "sigma_assumed": poses.told[number],
    }  # fmt: skip


def _cameras(poses: PicturePoses, pinholes: bool) -> dict[str, Any]:
    """Return the lenses of the copies by camera: OpenCV's camera matrix and distortion."""
    found: dict[str, Any] = {}
    for k in range(len(poses)):
        camera, lens = poses.pictures.logs[poses.pictures.log[k]].sensor, poses.pictures.views.lens_of(k)
        width, height = lens.size_px
        model = _pinhole(lens) if pinholes and not lens.is_around else lens
        fx, fy, cx, cy, *distortion = model.parameters[:9].tolist()
        found[camera] = {
            "model": "equirectangular" if lens.is_around else "perspective", "width_px": width, "height_px": height,
            "focal_px": [fx, fy], "principal_px": [cx, cy], "distortion": distortion,
        }  # fmt: skip
    return found


def _rational(value: float, steps: int = 10**6) -> Any:
    """Return a number as EXIF has it: a fraction, here of millionths."""
    from PIL.TiffImagePlugin import IFDRational

    return IFDRational(round(value * steps), steps)


def _sexagesimal(degrees: float) -> tuple[Any, Any, Any]:
    """Return degrees, minutes and seconds; seconds to 10⁻⁷ (3 µm)."""
    parts = round(abs(degrees) * 3600 * 10**7)
    seconds, whole = parts % (60 * 10**7), parts // (60 * 10**7)
    return _rational(whole // 60, 1), _rational(whole % 60, 1), _rational(seconds / 10**7, 10**7)
