"""Scenes with what each of their returns is, for the fitting of judges: a recorded street, and simulated ones.

Of the recording only sweeps 0 to 3 are shown, as seen by all of them, by two and by one, each once more as a worse
survey has them. Simulated streets are hard ones of all kinds, motorways among them, and plain ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import pandas as pd

from benchmarks.asset_streets import LOW_POST_M
from benchmarks.drawn_streets import drawn_street
from benchmarks.hard_streets import hard_street
from benchmarks.labelled_returns import CLASSES, LabelledReturns, labelled_returns
from benchmarks.labelled_street import labelled_sweeps, laid_out, recording_folder
from benchmarks.street_classes import SHAFT_OF_KIND, SHAFTS
from benchmarks.street_scores import CAR, NOT_JUDGED, VEGETATION
from benchmarks.street_scores import POLE as POLE_LABEL
from benchmarks.street_scores import SIGN as SIGN_LABEL
from benchmarks.street_scores import TRUNK as TRUNK_LABEL
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Returns, Scene
from roadscan.simulate import Scene as Street

Float64 = npt.NDArray[np.float64]
UInt8 = npt.NDArray[np.uint8]

UNKNOWN, OTHER, VEHICLE, PERSON, TRUNK, POLE, LEAVES = range(7)
"""What a return is: not judged, anything else, a vehicle, a person, a trunk, a pole (or what stands on it), leaves."""
_OF_LABEL: Final = {**dict.fromkeys(NOT_JUDGED, UNKNOWN), CAR: VEHICLE, TRUNK_LABEL: TRUNK, POLE_LABEL: POLE,
                    SIGN_LABEL: POLE, VEGETATION: LEAVES}  # fmt: skip
_OF_CLASS: Final = {"noise": UNKNOWN, "vehicle": VEHICLE, "person": PERSON, "trunk": TRUNK, "pole": POLE,
                    "sign": POLE, "signal": POLE, "vegetation": LEAVES, "hedge": LEAVES}  # fmt: skip
_OF_KIND: Final = {"bollard": POLE, "hydrant": UNKNOWN, "parking_meter": UNKNOWN}
"""Things of the class `furniture` that are posts, and those of which it is a matter of words."""
HARD: Final = range(18)
PLAIN: Final = range(200, 208)
"""Seeds of hard streets, three of each of six kinds, and of plain ones."""
_SUBSETS: Final = ((0, 1, 2, 3), (0, 1), (2, 3), (0, 2), (1, 3), (0,), (1,), (2,), (3,))
"""Sweeps of the recording that are taken together: a street is seen once, or by many passes."""
_RECORDED, _PLAIN_WEIGHT = 1.0, 2.0
"""How much a segment of the recording, and of a plain street, counts: plain streets have few."""
_PART_M: Final = 20.0
"""Edge of the parts of the recorded street that are held out together (m)."""
_HALF_M: Final = 80.0
"""Half the edge of the window about the recorded street (m)."""
_NEAREST_M: Final = 2.5
"""What was nearer to the sensor (m) is the car that carries it."""
_SWEEP_NS: Final = 100_000_000
_BESIDE_M, _BEFORE_M = 22.0, 5.0
"""A simulated street is taken so far beside the middle of its road, and before and beyond its ends (m)."""


@dataclass(frozen=True, eq=False)
class JudgedScene:
    """A scene, and what its returns are."""

    scene: Scene
    what: UInt8
    """(n,) as numbered above."""
    types: UInt8
    """(n,) what type of shaft, an index of :data:`benchmarks.street_classes.SHAFTS`; that of the object met."""
    name: str
    source: str
    """"recorded", "hard" or "plain"."""
    weight: float

    def groups(self, places_m: Float64) -> npt.NDArray[np.str_]:
        """Groups (k,) of segments at places (k, 2): a simulated street is one, of the recorded each 20 m are one."""
        if self.source != "recorded":
            return np.full(len(places_m), self.name)
        return np.array([f"{self.name} {x:.0f} {y:.0f}" for x, y in np.floor(places_m / _PART_M).tolist()], np.str_)


def judged_scenes(folder: Path) -> Iterator[JudgedScene]:
    """Yield all scenes that judges are fitted to."""
    yield from recorded_scenes(folder)
    yield from simulated_scenes(HARD, PLAIN)


def recorded_scenes(folder: Path) -> Iterator[JudgedScene]:
    """Yield the scenes of the recorded street."""
    table = np.full(256, OTHER, np.uint8)
    for label, what in _OF_LABEL.items():
        table[label] = what
    for scene, label in recorded_views(folder):
        what = table[label]
        types = np.zeros(len(what), np.uint8)
        types[what == TRUNK], types[what == POLE] = SHAFTS.index("tree"), SHAFTS.index("post")
        yield JudgedScene(scene, what, types, "street", "recorded", _RECORDED)


def recorded_views(folder: Path) -> Iterator[tuple[Scene, UInt8]]:
    """Yield the scenes of the recorded street, with the label of each return (n,)."""
    laid_out(recording_folder(), folder / "sweeps-0-3", range(4))
    sweeps = _sweeps(folder / "sweeps-0-3")
    for number, subset in enumerate(_SUBSETS):
        chosen = [sweeps[k] for k in subset]
        yield _recorded(chosen)
        yield _recorded(_worse(chosen, number))


def simulated_scenes(hard: Iterable[int], plain: Iterable[int]) -> Iterator[JudgedScene]:
    """Yield the scenes of hard streets and of plain ones, by their seeds."""
    for seed in hard:
        yield simulated(hard_street(seed), "hard", 1.0)
    for seed in plain:
        yield simulated(drawn_street(seed), "plain", _PLAIN_WEIGHT)


def simulated(street: Street, source: str, weight: float, seen: LabelledReturns | None = None) -> JudgedScene:
    """Return the scene of a simulated street, of returns that were drawn before, or are drawn here."""
    seen = seen or labelled_returns(street)
    returns, (inside, window, _, _) = seen.returns, in_window(seen, street)
    table = np.full(len(CLASSES), OTHER, np.uint8)
    for name, number in _OF_CLASS.items():
        table[CLASSES.index(name)] = number
    what = table[seen.class_id[inside]]
    for kind in set(_OF_KIND) & set(seen.kinds):
        what[seen.kind[inside] == seen.kinds.index(kind)] = _OF_KIND[kind]
    scene = make_scene(returns.at(inside), window, window, seen.drive_xyh_m)
    types = _shaft_types(seen.objects)[np.maximum(seen.object_id[inside], 0)]
    return JudgedScene(scene, what, types, street.id, source, weight)


def _shaft_types(objects: pd.DataFrame) -> UInt8:
    """Return the type of the shaft of each object by its number; number 0 is the ground."""
    out = np.zeros(int(objects.object_id.max()) + 1 if len(objects) else 1, np.uint8)
    for number, kind, high_m in zip(*(objects[n].tolist() for n in ("object_id", "kind", "size_up_m")), strict=True):
        name = "delineator" if kind == "pole" and high_m <= LOW_POST_M else SHAFT_OF_KIND.get(kind, "")
        out[number] = SHAFTS.index(name)
    return out


def in_window(seen: LabelledReturns, street: Street) -> tuple[npt.NDArray[np.int64], Box, Float64, Float64]:
    """Rows (k,) of the returns of a simulated street that are taken, their window, stations and offsets (k,; m)."""
    returns, (east, north) = seen.returns, seen.returns.corner_m
    station, offset = seen.surface.station_offset_m(east + returns.x_m, north + returns.y_m)
    inside = np.flatnonzero(
        (np.abs(offset) < _BESIDE_M) & (station > -_BEFORE_M) & (station < street.length_m + _BEFORE_M)
    )
    place = np.stack([returns.x_m[inside], returns.y_m[inside]])
    window = Box(*(np.floor(place.min(axis=1) / 3.0) * 3.0 - 3.0), *(np.ceil(place.max(axis=1) / 3.0) * 3.0 + 3.0))
    return inside, window, station[inside], offset[inside]


# --- the recording -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A turn of the scanner, in the frame of sweep 0."""

    number: int
    sensor_m: Float64
    places_m: Float64
    """(n, 3)."""
    label: UInt8


def _sweeps(folder: Path) -> list[_Sweep]:
    """Sweeps of a survey that was laid out, without the car that carries the scanner."""
    table = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    sensor = {int(row[0]): row[2:14].reshape(3, 4)[:, 3] for row in table}
    out = []
    for number, (places, label) in enumerate(labelled_sweeps(folder)):
        kept = np.linalg.norm(places - sensor[number], axis=1) >= _NEAREST_M
        out.append(_Sweep(number, sensor[number], np.round(places[kept], 3), label[kept]))
    return out


def _worse(sweeps: Sequence[_Sweep], seed: int) -> list[_Sweep]:
    """Sweeps as a worse survey has them: half to all returns, up to 20 mm of noise, steps of poses of up to 40 mm."""
    random = np.random.default_rng([seed, 3737])
    share, noise_m, step_m = random.uniform([0.45, 0.0, 0.0], [1.0, 0.02, 0.04])
    out = []
    for one in sweeps:
        kept = random.random(len(one.label)) < share
        sight = one.places_m[kept] - one.sensor_m
        away = random.normal(0.0, noise_m, len(sight)) / np.linalg.norm(sight, axis=1)
        places = one.places_m[kept] + sight * away[:, None] + random.normal(0.0, step_m, 3)
        out.append(replace(one, places_m=np.round(places, 3), label=one.label[kept]))
    return out


def _recorded(sweeps: Sequence[_Sweep]) -> tuple[Scene, UInt8]:
    """Return the scene of some sweeps, and the label of each return (n,)."""
    window = Box(-_HALF_M, -_HALF_M, _HALF_M, _HALF_M)
    returns, number = _returns(sweeps), np.concatenate([one.label for one in sweeps])
    inside = window.holds(returns.x_m, returns.y_m)
    drive = np.array([[*one.sensor_m, 1.0] for one in sweeps])
    scene = make_scene(returns.at(inside), window, window, drive)
    return scene, number[inside]


def _returns(sweeps: Sequence[_Sweep]) -> Returns:
    """Returns of some sweeps, an epoch each; nothing that is judged here asks for the laser or the intensity."""
    count = [len(one.label) for one in sweeps]
    x, y, height = np.concatenate([one.places_m for one in sweeps]).T.copy()
    sensor = np.repeat([one.sensor_m for one in sweeps], count, axis=0).T.copy()
    n = x.size
    return Returns(
        corner_m=(0.0, 0.0), x_m=x, y_m=y, height_m=height, intensity=np.full(n, 1.0, np.float32),
        epoch_gps_ns=np.repeat([one.number * _SWEEP_NS for one in sweeps], count), pass_id=np.ones(n, np.uint16),
        sensor=np.zeros(n, np.uint8), laser=np.zeros(n, np.uint16), return_number=np.ones(n, np.uint8),
        number_of_returns=np.ones(n, np.uint8), sensor_x_m=sensor[0], sensor_y_m=sensor[1], sensor_height_m=sensor[2],
        sensors=("velodyne",),
    )  # fmt: skip
