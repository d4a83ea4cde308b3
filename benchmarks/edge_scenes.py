"""Scenes whose truth is known, as the stage `assets` makes them: what judges of edges and paint are fitted to.

Simulated ones are hard streets, plain drawn ones, and the benchmark's town and motorway seen otherwise; recorded
is the first half of the labelled street, as surveys of some of its sweeps. Its parts are groups of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from benchmarks import street_scores as scores
from benchmarks.asset_streets import motorway, town
from benchmarks.drawn_streets import drawn_street
from benchmarks.hard_streets import SCANNERS, hard_street
from benchmarks.labelled_returns import CLASSES, labelled_returns
from benchmarks.labelled_scenes import labelled_scenes
from benchmarks.labelled_street import LabelledStreet, read_street, recording_folder
from benchmarks.street_classes import kerb_heights
from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample
from roadscan.assets.make_scene import make_scene
from roadscan.assets.scene import Box, Scene
from roadscan.simulate import Scene as Street
from roadscan.simulate.surface import Surface

Float64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Truth = Callable[[Float64, Float64], tuple[Bools, Float64]]

SUBSETS: Final = ((0, 1, 2, 3), (0,), (3,), (1, 2))
"""Sweeps of the recorded scenes: a street is seen once, twice and more often."""
HARD: Final = (*range(18), *range(700, 705))
DRAWN: Final = range(200, 206)
SEEN_OTHERWISE: Final = range(300, 308)
"""Seeds of the simulated streets."""
_BESIDE_M: Final = 25.0  # Returns of a simulated street farther from its axis (m) are left out.
_PART_M: Final = 15.0  # Edge of the parts of the recorded street (m).
LOWEST_M: Final = 0.015
"""Lower kerbs of the simulator (m) are not judged."""


@dataclass(frozen=True, eq=False)
class JudgedScene:
    """A scene and its truth."""

    name: str
    source: str
    scene: Scene
    is_paint: Bools
    """(n,) of each return."""
    is_judged: Bools
    """(n,) False where nobody said what a return met."""
    kerb: Truth
    """From places (k,) in the scene: which lie at a kerb, and how much that counts: 0 where it is not known."""

    def groups(self, x_m: Float64, y_m: Float64) -> npt.NDArray[Any]:
        """Names (k,) of the groups of places: those of a simulated street are one, of a recorded one its parts."""
        if self.source == "simulated":
            return np.full(len(x_m), self.name)
        corner = self.scene.returns.corner_m
        east, north = (np.floor((v + c) / _PART_M).astype(int) for v, c in zip((x_m, y_m), corner, strict=True))
        return np.array([f"{self.source} {e} {n}" for e, n in zip(east, north, strict=True)])


def judged_scenes(folder: Path) -> Iterator[JudgedScene]:
    """All of them; surveys of the recording are run below a folder."""
    for seeds, drawn in ((HARD, hard_street), (DRAWN, drawn_street), (SEEN_OTHERWISE, seen_otherwise)):
        yield from (simulated(drawn(seed)) for seed in seeds)
    yield from recorded(folder)


def seen_otherwise(seed: int) -> Street:
    """The benchmark's motorway or town, by another scanner, at another speed, with other noise and other paint."""
    random = np.random.default_rng([seed, 41])
    between = random.uniform
    model = str(random.choice(SCANNERS))
    plain = motorway(60.0) if seed % 2 else town(44.0)
    paint = [one.model_dump() | {"width_m": float(between(0.10, 0.32))} for one in plain.road.markings]
    lanes = random.permutation([1, 2, 3] if seed % 2 else [1, 2])[: int(random.integers(1, 3))]
    tilted = model != "HDL-64E" and random.random() < 0.6
    mount = plain.lidar.mount.model_dump() if tilted else {
        "lever_arm_body_m": (0.0, 0.0, -float(between(1.5, 2.2))), "roll_deg": 0.0, "pitch_deg": 0.0,
        "heading_deg": float(between(-180, 180)),
    }  # fmt: skip
    return plain.changed(
        id=f"otherwise-{seed}", seed=7000 + seed, passes=[{"lane": int(lane)} for lane in lanes],
        bag={"on": model in ("HDL-64E", "VLP-16")},
        vehicle={"speed_m_per_s": float(between(17, 27) if seed % 2 else between(9, 14)), "standstill_s": 0.0},
        lidar={"model": model, "range_max_m": float(between(25, 50)), "mount": mount},
        noise={"lidar_range_m": float(between(0.003, 0.025)), "intensity": float(between(2, 10))},
        road={"markings": paint, "brightness": {"marking": float(between(100, 230))}},
    )  # fmt: skip


def simulated(settings: Street) -> JudgedScene:
    """A street of the simulator."""
    street = labelled_returns(settings)
    corner = street.returns.corner_m
    station, offset = street.surface.station_offset_m(
        street.returns.x_m + corner[0], street.returns.y_m + corner[1])  # fmt: skip
    rows = np.flatnonzero((np.abs(offset) < _BESIDE_M) & (station > -5.0) & (station < settings.length_m + 5.0))
    rows = rows[np.lexsort((street.returns.laser[rows], street.returns.epoch_gps_ns[rows]))]
    returns = street.returns.at(rows)
    places = np.stack([returns.x_m, returns.y_m])
    box = Box(*3.0 * np.floor(places.min(axis=1) / 3.0 - 1.0), *3.0 * np.ceil(places.max(axis=1) / 3.0 + 1.0))
    scene = make_scene(returns, box, box, street.drive_xyh_m)
    scene = calibrated_scene(scene, gains_of([intensity_sample(scene)]))
    own = street.class_id[rows]
    return JudgedScene(settings.id, "simulated", scene, own == CLASSES.index("marking"), own != CLASSES.index("noise"),
                       simulated_kerbs(street.surface, settings, corner))  # fmt: skip


def simulated_kerbs(surface: Surface, settings: Street, corner_m: tuple[float, float]) -> Truth:
    """Kerbs stand where the paved surface ends, as high as they are drawn; what is near to one is not judged."""

    def kerb(x_m: Float64, y_m: Float64) -> tuple[Bools, Float64]:
        station, offset = surface.station_offset_m(x_m + corner_m[0], y_m + corner_m[1])
        away, height = np.abs(np.abs(offset) - settings.road.paved_m), np.zeros(len(x_m))
        kerb_heights(surface.arrays, station, offset, height)
        near = away < 0.25
        unknown = (near & (height < LOWEST_M) & (height > 0.0)) | ((away >= 0.25) & (away < 0.45))
        return near & (height >= LOWEST_M), np.where(unknown, 0.0, 1.0)

    return kerb


def recorded(folder: Path) -> Iterator[JudgedScene]:
    """Squares of the surveys of the labelled street; its kerbs are those of all sweeps together."""
    kerb = None
    for sweeps in SUBSETS:
        own = folder / f"judged-{'-'.join(map(str, sweeps))}"
        for number, (scene, labels) in enumerate(labelled_scenes(recording_folder(), own, sweeps)):
            kerb = kerb or _labelled_kerbs(read_street(own))
            yield JudgedScene(f"sweeps {sweeps}, square {number}", "semantic_kitti_00", scene, labels == scores.MARKING,
                              ~np.isin(labels, scores.NOT_JUDGED), _from(kerb, scene.returns.corner_m))  # fmt: skip


def _labelled_kerbs(street: LabelledStreet) -> Truth:
    """Kerbs are edges of road and sidewalk; edges of road and terrain may be kerbs, and are not judged."""
    paved, plants = (cKDTree(scores.labelled_edges(street.places_m, street.labels, (of,)).places)
                     for of in (scores.SIDEWALK, scores.TERRAIN))  # fmt: skip
    known = cKDTree(street.places_m[np.isin(street.labels, scores.GROUND), :2])

    def kerb(x_m: Float64, y_m: Float64) -> tuple[Bools, Float64]:
        place = np.column_stack([x_m, y_m])
        away, doubtful = paved.query(place)[0], plants.query(place)[0]
        near = away < 0.3
        unknown = (~near & ((doubtful < 0.5) | (away < 0.5))) | (known.query(place)[0] > 0.4)
        return near, np.where(unknown, 0.0, 1.0)

    return kerb


def _from(truth: Truth, corner_m: tuple[float, float]) -> Truth:
    """The truth for places that count from a corner."""
    return lambda x_m, y_m: truth(x_m + corner_m[0], y_m + corner_m[1])
