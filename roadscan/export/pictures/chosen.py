"""The pictures that an export is about, and a local frame for their poses."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Final

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import LOCAL_WORLD, crs_from_text
from roadscan.core.errors import ConfigError, nearest
from roadscan.core.frames import ENU_FROM_NED
from roadscan.measuring.measure import posed_pictures
from roadscan.measuring.poses import PicturePoses
from roadscan.measuring.work import picked_poses
from roadscan.poses.trajectory import world_from_ned
from roadscan.run.session import Session

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
