"""Search of assets in pictures: the best views, cut-outs of signs, colours of paint."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from roadscan.assets.kernels.sight import find_hidden
from roadscan.assets.kind import AssetObject, objects_of_table
from roadscan.assets.pictures.reader import ColourReader, CutOut, CutOutReader, Sight, picture_readers, sight_of
from roadscan.assets.tasks.picture_work import CUT_OUTS, SEEN, PictureTask, SquareObjects, around, rows_by_square
from roadscan.assets.tasks.recognition import recognition_of
from roadscan.assets.visibility import EDGE_M, SCREENS
from roadscan.compute.array_types import Bool, Float64, Int64
from roadscan.core.extras import cv2
from roadscan.core.grid import Bounds
from roadscan.pictures.colours import ColourSource, world_places
from roadscan.pictures.placed import Pictures
from roadscan.pictures.views import NO_VIEW, WIDTH, Sights, best_views, sights
from roadscan.run.engine.compute import reason_of
from roadscan.store.digest import bytes_digest
from roadscan.store.manifest import OutputRecord, publish_table, recorded_table
from roadscan.tiles.tasks.tiles import TaskResult

_WALKED_M: Final = np.array([1.5, 0.8, 0.25])
"""A line of sight is tested from this far beyond the camera to this far before the object, in steps of this (m)."""


def best_sights(looks: Sequence[Sight], pictures: Pictures, screens: pa.Table) -> Sights:
    """Returns the pictures that show n objects, each object's best first, without those in which something hides it.

    Parameters
    ----------
    looks : what a picture must show of each object, with the same number of places each.
    screens : voxels that hide (:data:`roadscan.assets.visibility.SCREENS`).
    """
    places = np.stack([one.places_m for one in looks])
    flat = places.reshape(-1, 3)
    front = np.array([np.full(3, np.nan) if one.facing is None else one.facing for one in looks])
    worlds, fronts = [], []
    for world in pictures.worlds:
        own = world_places(pictures, world, flat).reshape(places.shape)
        worlds.append(own)
        ahead = world_places(pictures, world, places[:, 0] + np.nan_to_num(front)) - own[:, 0]
        fronts.append(np.where(np.isnan(front), np.nan, ahead))
    every = np.arange(len(looks))
    found = sights(worlds, fronts, pictures.views, pictures.rule, ((n, every) for n in range(len(pictures))))
    return found.at(~_hidden(found, places[:, 0], pictures, screens))


def _hidden(found: Sights, places_m: Float64, pictures: Pictures, screens: pa.Table) -> Bool:
    """Returns a mask (n,) of the sights that are obstructed."""
    eyes = _eyes_m(pictures)[found.view]
    return _lines_hidden(eyes, places_m[found.item], pictures.epochs_gps_ns[found.view], screens)


def hidden_cells(pictures: Pictures, number: int, places_m: Float64, screens: pa.Table) -> Bool:
    """Returns a mask (n,) of the places (n, 3) that something hides from one picture."""
    one = pictures.chosen(np.array([number]))
    every = np.zeros(len(places_m), np.int64)
    return _lines_hidden(_eyes_m(one)[every], places_m, one.epochs_gps_ns[every], screens)


def _lines_hidden(eyes_m: Float64, places_m: Float64, epochs_gps_ns: Int64, screens: pa.Table) -> Bool:
    """Returns a mask (n,) of the lines from cameras to places (n, 3) that voxels obstruct."""
    hidden = np.zeros(len(places_m), np.bool_)
    if not (len(places_m) and screens.num_rows):
        return hidden
    voxel = np.column_stack([screens[name].to_numpy() for name in ("column", "row", "level")]).astype(np.int64)
    low = voxel.min(axis=0)
    shape = voxel.max(axis=0) - low + 1
    key = ((voxel[:, 0] - low[0]) * shape[1] + voxel[:, 1] - low[1]) * shape[2] + voxel[:, 2] - low[2]
    order = np.argsort(key, kind="stable")
    spans = np.column_stack([screens[name].to_numpy() for name in ("first_epoch_gps_ns", "last_epoch_gps_ns")])
    corner = low * EDGE_M
    find_hidden(
        np.ascontiguousarray(eyes_m - corner), np.ascontiguousarray(places_m - corner), epochs_gps_ns, key[order],
        np.ascontiguousarray(spans[order]), shape, EDGE_M, _WALKED_M,
        hidden,
    )  # fmt: skip
    return hidden


def _eyes_m(pictures: Pictures) -> Float64:
    """Returns easting, northing and height (n, 3) of the cameras."""
    views = pictures.views
    out = np.empty((len(views), 3))
    for number, world in enumerate(pictures.worlds):
        own = views.world == number
        out[own] = pictures.map.map_from_world(world, views.eye_world_m[own])
    return out


def named(found: Sights, pictures: Pictures, count: int, most: int) -> list[str | None]:
    """Returns the column `pictures` of `count` objects; None where no picture shows one."""
    words: list[list[dict[str, object]]] = [[] for _ in range(count)]
    for item, view, (u, v), distance in zip(
        found.item.tolist(), found.view.tolist(), found.pixel.tolist(), found.distance_m.tolist(), strict=True
    ):
        if len(words[item]) < most:
            log = pictures.logs[pictures.log[view]]
            words[item].append(
                {
                    "run": log.run, "camera": log.sensor, "file": pictures.files[view],
                    "epoch_gps_ns": int(pictures.epochs_gps_ns[view]), "u_px": round(u, 1), "v_px": round(v, 1),
                    "distance_m": round(distance, 2),
                }
            )  # fmt: skip
    return [json.dumps(one, ensure_ascii=False) if one else None for one in words]


TOLD: Final = pa.schema([("object", pa.string()), ("pictures", pa.string()), ("told", pa.string())])
"""What pictures show of objects: `told` contains columns of the kind as JSON."""
FOLDER: Final = "products/asset_pictures"
_JPEG_QUALITY: Final = 90  # quality of cut-outs: writing on signs stays readable
_LEAST_MARGIN_PX: Final = 6.0  # least margin around an object (pixels)
_GREY_STEP: Final = 16  # each 16th pixel is looked at for colour
_GREY_WITHIN: Final = 3  # largest difference of the channels of a grey picture (digital numbers): JPEG rounds


def find_pictures(task: PictureTask) -> TaskResult:
    """Search the objects of a task in its pictures, and write the results (runs on a worker)."""
    records: list[OutputRecord] = []
    failures: list[tuple[str, str]] = []
    source = ColourSource(task.pictures)
    search = _Search(task, source)
    for one in task.work:
        try:
            records += search.records(one)
        except Exception as error:  # noqa: BLE001  one square's fault must not stop the others
            failures.append((one.unit, reason_of(error)))
    return TaskResult.of(records, failures)


@dataclass
class _Answer:
    """Results of the objects of a square."""

    pictures: list[str | None]
    told: list[dict[str, Any]]
    files: list[OutputRecord] = field(default_factory=list)
    unreadable: set[str] = field(default_factory=set)


class _Search:
    """Objects during their search in pictures."""

    def __init__(self, task: PictureTask, source: ColourSource) -> None:
        self._task, self._source = task, source
        self._recognition = recognition_of(task.settings, task.recogniser)
        self._screens = {square: self._read(record) for square, record in task.screens}

    def records(self, one: SquareObjects) -> list[OutputRecord]:
        """Returns records of the results of a square's objects, and of the files of cut-outs."""
        grid = self._task.grid
        parts = [dict(rows_by_square(self._read(r), grid))[one.square] for r in one.objects]
        rows = pa.concat_tables(parts)
        objects = objects_of_table(rows)
        answer = self._answer(one, objects, rows["object"].to_pylist())
        table = pa.table([rows["object"], answer.pictures, [json.dumps(t, ensure_ascii=False) for t in answer.told]],
                         schema=TOLD)  # fmt: skip
        detail = {
            "objects": len(objects), "shown": sum(p is not None for p in answer.pictures),
            "cut_outs": [record.unit for record in answer.files], "unreadable": sorted(answer.unreadable),
        }  # fmt: skip
        seen = publish_table(self._task.store, table, SEEN, one.unit, one.key, json.dumps(detail, ensure_ascii=False))
        return [*answer.files, seen]

    def _answer(self, one: SquareObjects, objects: Sequence[AssetObject], names: Sequence[str]) -> _Answer:
        settings, near = self._task.settings, self._task.pictures.near(one.box)
        if not len(near):
            return _Answer([None] * len(objects), [{} for _ in objects])
        hides = around(one.square, dict(self._task.screens), self._task.grid, settings.reach_m)
        screens = pa.concat_tables([SCREENS.empty_table(), *(self._screens[square] for square, _ in hides)])
        found = best_sights([sight_of(one.kind, o) for o in objects], near, screens)
        answer = _Answer(named(found, near, len(objects), settings.most), [{} for _ in objects])
        reader = picture_readers().get(one.kind)
        if isinstance(reader, CutOutReader):
            self._cut(one, reader, objects, names, _Shown(near, found), answer)
        elif isinstance(reader, ColourReader):
            for number, asset in enumerate(objects):
                answer.told[number] = dict(self._coloured(reader, asset, answer))
        return answer

    def _cut(
        self,
        one: SquareObjects,
        reader: CutOutReader,
        objects: Sequence[AssetObject],
        names: Sequence[str],
        shown: _Shown,
        answer: _Answer,
    ) -> None:
        """Cut objects out of the pictures that show them best, and read them."""
        for number, asset in enumerate(objects):
            outline = reader.outline_m(asset)
            if outline is None:
                continue
            cut = self._cut_outs(outline, shown.of(number), shown.pictures, answer)
            if not cut:
                continue
            told = dict(reader.read(asset, cut, self._recognition))
            if self._task.settings.cut_outs:
                files = [self._kept(one, f"{names[number]}_{n}", c) for n, c in enumerate(cut, 1)]
                answer.files += files
                told["cut_out"] = files[0].path
            answer.told[number] = told

    def _cut_outs(self, outline_m: Float64, found: Sights, pictures: Pictures, answer: _Answer) -> list[CutOut]:
        """Returns cut-outs of the best pictures that can be read."""
        worlds = [world_places(pictures, world, outline_m) for world in pictures.worlds]
        cut: list[CutOut] = []
        for view, resolution in zip(found.view.tolist(), found.resolution_m.tolist(), strict=True):
            pixels = best_views(worlds, pictures.views.picked(np.array([view])), pictures.rule)
            lens = pictures.views.lens_of(view)
            torn = lens.is_around and np.ptp(pixels.pixel[:, 0]) > lens.parameters[WIDTH] / 2  # by the picture's ends
            if torn or (pixels.view == NO_VIEW).any():
                continue
            picture = self._source.picture(pictures, view)
            if picture is None:
                answer.unreadable.add(pictures.name(view))
                continue
            cut.append(_cut_out(picture, pixels.pixel, resolution, self._task.settings.margin))
            if len(cut) == self._task.settings.most:
                break
        return cut

    def _kept(self, one: SquareObjects, name: str, cut: CutOut) -> OutputRecord:
        """Write a cut-out."""
        quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        done, encoded = cv2.imencode(".jpg", np.ascontiguousarray(cut.pixels[:, :, ::-1]), quality)
        if not done:
            raise OSError(f"the cut-out {name} cannot be encoded")
        content, target = encoded.tobytes(), f"{FOLDER}/{one.kind}/{name}.jpg"
        self._task.store.write_bytes(target, content, lasting=False)
        unit = f"{one.kind}/{name}"
        return OutputRecord(CUT_OUTS, unit, one.key, target, len(content), bytes_digest(content))

    def _coloured(self, reader: ColourReader, asset: AssetObject, answer: _Answer) -> Mapping[str, Any]:
        """Returns the columns from the colours of an object and beside it."""
        places = reader.places(asset)
        every = np.vstack([places.own_m, places.beside_m])
        if not len(every):
            return {}
        (west, south), (east, north) = every[:, :2].min(axis=0).tolist(), every[:, :2].max(axis=0).tolist()
        found = self._source.colours(self._task.pictures.near(Bounds(west, south, east, north)), every)
        answer.unreadable.update(found.unreadable)
        is_own = np.arange(len(every)) < len(places.own_m)
        return reader.read(found.colour[is_own & found.seen], found.colour[~is_own & found.seen])

    def _read(self, record: OutputRecord) -> pa.Table:
        return recorded_table(self._task.store, record)


@dataclass(frozen=True, eq=False)
class _Shown:
    """Sights of objects, and the pictures to which they refer."""

    pictures: Pictures
    sights: Sights

    def of(self, item: int) -> Sights:
        """Returns those of one object."""
        return self.sights.at(np.flatnonzero(self.sights.item == item))


def _cut_out(picture: npt.NDArray[np.uint8], outline_px: Float64, resolution_m: float, margin: float) -> CutOut:
    """Returns the part of a picture around an outline (k, 2)."""
    low, high = outline_px.min(axis=0), outline_px.max(axis=0)
    beyond = np.maximum(margin * (high - low), _LEAST_MARGIN_PX)
    height, width = picture.shape[:2]
    left, top = np.maximum(np.floor(low - beyond), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high + beyond) + 1, [width, height]).astype(int).tolist()
    sample = picture[::_GREY_STEP, ::_GREY_STEP].astype(np.int16)
    is_grey = bool(np.quantile(np.ptp(sample, axis=2), 0.99) <= _GREY_WITHIN)
    return CutOut(picture[top:bottom, left:right].copy(), outline_px - [left, top], resolution_m, is_grey)
