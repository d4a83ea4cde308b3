"""Hides people and vehicles in pictures of a survey, by what its settings name."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import scipy.spatial
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from roadscan.assets.classes import PERSON, VEHICLE
from roadscan.assets.settings import AssetsConfig
from roadscan.assets.tasks.evidence import CLASSIFIED
from roadscan.assets.tasks.plan import asset_grid
from roadscan.compute.array_types import Float64, Int64, UInt8
from roadscan.core.errors import ConfigError
from roadscan.core.extras import cv2
from roadscan.core.gpstime import NS_PER_S
from roadscan.core.grid import Bounds, TileGrid, TileId
from roadscan.pictures.colours import world_places
from roadscan.pictures.lens import pixels_of
from roadscan.pictures.placed import Pictures
from roadscan.pictures.views import HEIGHT, WIDTH
from roadscan.privacy.detector import KINDS, Detector, Region, hidden
from roadscan.privacy.settings import PrivacyConfig
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session, found_once
from roadscan.store.digest import file_digest
from roadscan.store.manifest import OutputRecord, read_recorded
from roadscan.store.store import Store

_WHAT: Final = {VEHICLE: "vehicle", PERSON: "person"}
_WINDOW_S: Final = 0.2
"""Returns of what moves hide what a picture shows within so long of them: two turns of a scanner of 10 Hz (s)."""
_STAYS_S: Final = 1.0
"""A cube in which one class is seen over so long holds something that stands, which hides at any time (s)."""
_CUBE_M: Final = 0.5  # Edge of such a cube (m).
_ONE_THING_M: Final = 0.7
"""Returns nearer to each other belong to one thing (m)."""
_GRAIN_M: Final = 0.25  # Edge of the cubes that stand for the returns in them when things are distinguished (m).
_AROUND_M: Final = 0.25
"""Around each return so much is hidden: scanners leave gaps, and glass returns nothing (m)."""
_KEPT_SQUARES: Final = 12  # Squares whose returns stay in memory.
_LEAST_AHEAD_M: Final = 0.5
"""Nearer to the camera than this nothing is hidden (m)."""


@dataclass(frozen=True)
class _Seen:
    """Returns of vehicles and people."""

    place_m: Float64
    """(n, 3) on the map."""
    code: npt.NDArray[np.uint8]
    epoch_gps_ns: Int64
    stays: npt.NDArray[np.bool_]

    def at(self, rows: Any) -> _Seen:
        return _Seen(self.place_m[rows], self.code[rows], self.epoch_gps_ns[rows], self.stays[rows])


# Returns of a picture that none was near.
_NONE: Final = _Seen(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0, np.int64), np.zeros(0, np.bool_))


@dataclass(frozen=True, eq=False)
class ClassedReturns:
    """The classified points of a survey, read square by square."""

    store: Store
    squares: TileGrid
    records: Mapping[TileId, OutputRecord]
    _held: OrderedDict[TileId, _Seen] = field(default_factory=OrderedDict)

    @classmethod
    def of(cls, session: Session) -> ClassedReturns | None:
        """Return those of a survey; None where it has no classified points."""
        config = AssetsConfig.stated(session.survey)
        records = {TileId.parse(r.unit): r for r in session.manifest.of(CLASSIFIED).values() if r.path}
        if config is None or not records:
            return None
        return cls(session.store, asset_grid(session.survey, config).squares, records)

    def near(self, east_m: float, north_m: float, reach_m: float) -> list[OutputRecord]:
        """Return the records of the squares within reach of a place, by row and column."""
        return [self.records[square] for square in self._around(east_m, north_m, reach_m)]

    def regions(self, pictures: Pictures, number: int, reach_m: float) -> list[Region]:
        """Return what vehicles and people cover in a picture; what stands before them is not looked at."""
        east, north = pictures.place_m[number].tolist()
        parts = [_NONE, *(self._read(square) for square in self._around(east, north, reach_m))]
        epoch = int(pictures.epochs_gps_ns[number])
        found = []
        for part in parts:
            apart = np.abs(part.epoch_gps_ns - epoch)
            far = np.hypot(part.place_m[:, 0] - east, part.place_m[:, 1] - north)
            found.append(part.at((far <= reach_m) & (part.stays | (apart <= _WINDOW_S * NS_PER_S))))
        place = np.concatenate([one.place_m for one in found])
        code = np.concatenate([one.code for one in found])
        return [region for kind in _WHAT for region in _covered(pictures, number, place[code == kind], _WHAT[kind])]

    def _around(self, east_m: float, north_m: float, reach_m: float) -> list[TileId]:
        box = Bounds(east_m - reach_m, north_m - reach_m, east_m + reach_m, north_m + reach_m)
        found = [square for square in self.records if self.squares.bounds(square).meets(box)]
        return sorted(found, key=lambda t: (t.row, t.column))

    def _read(self, square: TileId) -> _Seen:
        if square not in self._held:
            with self.store.scratch() as folder:
                path = Path(folder) / "points.laz"
                path.write_bytes(read_recorded(self.store, self.records[square]))
                self._held[square] = _read(path)
        self._held.move_to_end(square)
        while len(self._held) > _KEPT_SQUARES:
            self._held.popitem(last=False)
        return self._held[square]


def _read(path: Path) -> _Seen:
    """Return the vehicles and people of a file of classified points."""
    import laspy

    points: Any = laspy.read(path)
    code = np.asarray(points.classification, np.uint8)
    own = np.isin(code, list(_WHAT))
    place = np.asarray(points.xyz, np.float64)[own]
    if not len(place):
        return _NONE
    seconds = np.asarray(points.gps_time, np.float64)[own]
    offset = 1_000_000_000 if points.header.global_encoding.gps_time_type == 1 else 0  # adjusted standard GPS time
    epoch = np.rint((seconds + offset) * NS_PER_S).astype(np.int64)
    cubes = np.column_stack([np.floor(place / _CUBE_M).astype(np.int64), code[own].astype(np.int64)])
    _, cube = np.unique(cubes, axis=0, return_inverse=True)
    cube = cube.reshape(-1)
    first, last = (np.full(int(cube.max()) + 1, v, np.int64) for v in (np.iinfo(np.int64).max, np.iinfo(np.int64).min))
    np.minimum.at(first, cube, epoch)
    np.maximum.at(last, cube, epoch)
    stays = (last - first)[cube] >= _STAYS_S * NS_PER_S
    return _Seen(place, code[own], epoch, stays)


def _things(place_m: Float64) -> tuple[int, Int64]:
    """Return how many things returns (n, 3) show, and the number of each one's thing: cubes that are near to others."""
    cube, of_return = np.unique(np.floor(place_m / _GRAIN_M).astype(np.int64), axis=0, return_inverse=True)
    pairs = scipy.spatial.cKDTree(cube).query_pairs(_ONE_THING_M / _GRAIN_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=(len(cube), len(cube)))
    count, thing = connected_components(graph, directed=False)
    return int(count), thing[of_return.reshape(-1)]


def _covered(pictures: Pictures, number: int, place_m: Float64, what: str) -> list[Region]:
    """Return a region for each thing that returns (n, 3) of one class belong to."""
    if not len(place_m):
        return []
    count, thing = _things(place_m)
    views = pictures.views
    lens = views.lens_of(number)
    world = world_places(pictures, pictures.worlds[views.world[number]], place_m)
    own = (world - views.eye_world_m[number]) @ views.opencv_from_world[number].T
    ahead = np.linalg.norm(own, axis=1) if lens.is_around else own[:, 2]
    pixel = pixels_of(lens, own)
    usable = (ahead >= _LEAST_AHEAD_M) & np.isfinite(pixel).all(axis=1)
    beyond = _AROUND_M * lens.parameters[:2] / np.maximum(ahead, _LEAST_AHEAD_M)[:, None]
    low, high = pixel - beyond, pixel + beyond
    width, height = lens.parameters[WIDTH], lens.parameters[HEIGHT]
    inside = usable & (high[:, 0] >= 0) & (high[:, 1] >= 0) & (low[:, 0] <= width - 1) & (low[:, 1] <= height - 1)
    regions = []
    for k in range(count):
        rows = inside & (thing == k)
        if rows.any():
            left, top = low[rows].min(axis=0).tolist()
            right, bottom = high[rows].max(axis=0).tolist()
            regions.append(Region(left, top, right, bottom, what))
    return regions


@dataclass(frozen=True, eq=False)
class Hider:
    """Hides people and vehicles in pictures."""

    config: PrivacyConfig
    returns: ClassedReturns | None
    model: Path | None

    @classmethod
    def of(cls, session: Session) -> Hider:
        """Return the hider of a survey.

        Raises
        ------
        ConfigError
            where nothing says what is to be hidden: neither classified points nor a detector.
        """
        config = PrivacyConfig.of(session.survey)
        returns = ClassedReturns.of(session) if config.from_classes else None
        model = None if config.detector is None else session.survey.resolve(config.detector.model)
        if returns is None and model is None:
            raise ConfigError(
                "pictures are to be blurred, and nothing says where: the survey has no classified points, and "
                "privacy.detector names no network",
                expected="the stage assets with classified = true, or [privacy.detector]",
                change='name one of them, or state privacy.pictures = "off" and answer for it',
            )
        if model is not None and not model.is_file():
            raise ConfigError("the detector is not there", expected="privacy.detector.model, an ONNX file", file=model)
        return cls(config, returns, model)

    @property
    def sources(self) -> list[str]:
        """Names of what says where to blur."""
        found = ["returns of vehicles and people"] if self.returns is not None else []
        return found + ([f"detector {self.model.name}"] if self.model is not None else [])

    @cached_property
    def detector(self) -> Detector | None:
        """The network; None where none is named."""
        if self.model is None or self.config.detector is None:
            return None
        return Detector(self.model, self.config.detector)

    @cached_property
    def key(self) -> str:
        """Hash of the settings, the network and the code."""
        model = "" if self.model is None else file_digest(self.model)
        code = code_digest(f"{__name__}:Hider")
        return key_of(code, self.config.model_dump(mode="json", exclude={"detector": {"model"}}), model)

    def key_of(self, pictures: Pictures, number: int) -> str:
        """Return a hash of all that says what is hidden in a picture, besides the picture itself."""
        east, north = pictures.place_m[number].tolist()
        near = [] if self.returns is None else self.returns.near(east, north, self.config.reach_m)
        return key_of(self.key, [record.digest for record in near], pictures.lens_key, number_key(pictures, number))

    def regions(self, pictures: Pictures, number: int, picture: UInt8) -> list[Region]:
        """Return what is hidden in a picture (height, width, 3; red first), margins included."""
        found: list[Region] = []
        if self.returns is not None:
            found += self.returns.regions(pictures, number, self.config.reach_m)
        if self.detector is not None:
            found += self.detector.find(picture)
        return [one.wider(self.config.margin) for one in found]

    def hide(self, pictures: Pictures, number: int, picture: UInt8) -> tuple[UInt8, dict[str, int]]:
        """Return a picture with all that hidden, and how much of what was."""
        regions = self.regions(pictures, number, picture)
        return hidden(picture, regions), counts_of(regions)

    def hide_found(self, picture: UInt8) -> UInt8:
        """Return a cut-out with what the network finds hidden."""
        found = [] if self.detector is None else self.detector.find(picture)
        return hidden(picture, [one.wider(self.config.margin) for one in found])


@found_once
def hider_of(session: Session) -> Hider:
    """Return the hider of a survey; raises as :meth:`Hider.of`."""
    return Hider.of(session)


def number_key(pictures: Pictures, number: int) -> str:
    """Return a hash of a picture's pose."""
    views = pictures.views
    return key_of(views.eye_world_m[number].tolist(), views.opencv_from_world[number].tolist())


def counts_of(regions: list[Region]) -> dict[str, int]:
    """Return how many regions there are of each kind."""
    return {what: sum(one.what == what for one in regions) for what in KINDS}


def decoded(content: bytes) -> UInt8:
    """Return a picture (height, width, 3; red first) in the orientation of its sensor; OSError where it is damaged."""
    known = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), known) if content else None
    if picture is None:
        raise OSError("the image cannot be decoded")
    return np.ascontiguousarray(picture[:, :, ::-1])


def encoded(picture: UInt8, quality: int = 90) -> bytes:
    """Return a picture (height, width, 3; red first) as a JPEG without any tags."""
    done, content = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture[:, :, ::-1]), [int(cv2.IMWRITE_JPEG_QUALITY), quality]
    )
    if not done:
        raise OSError("the image cannot be encoded")
    return bytes(content.tobytes())
