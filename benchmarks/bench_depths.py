"""Depths of the lidar at tie points of simulated streets against the truth: what the ray of each tie point truly meets.

python -m benchmarks depths

Seed 11 was looked at; seeds 12 and 13 are only scored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np
import numpy.typing as npt

from benchmarks.timing import Figure
from roadscan.adjust.bundle.outcome import PictureOutcome
from roadscan.adjust.tasks import solution
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate
from roadscan.simulate.sensors import camera as simulated_camera
from roadscan.simulate.sensors.picture import EYE, Studio, _Eye
from roadscan.survey.run import run_stages

Float64 = npt.NDArray[np.float64]

SEEDS: Final = (11, 12, 13)
STAGES: Final = ("ingest", "navigate", "footprints", "picture_ties", "adjust")
BORESIGHT: Final = {"roll_deg": -0.7, "pitch_deg": 0.6, "heading_deg": -0.5}
"""By how much the stated boresight of the camera is off; its lever arm is 12 to 15 mm off."""
EDGE_M: Final = 0.10
"""A plane farther than this from what the ray meets is another surface."""


@dataclass
class _Seen:
    """What the pixels of each picture truly meet."""

    real: Any
    place_body_m: dict[int, npt.NDArray[np.float32]] = field(default_factory=dict)
    """(h, w, 3) by epoch (GPS ns), axes of the body at that instant; NaN: nothing, or glass."""

    def picture(self, studio: Studio, drive: Any, epoch_gps_ns: int, number: int) -> Any:
        """Return the picture, as the simulator does."""
        eye, camera = _Eye(studio, drive, epoch_gps_ns, number), studio.camera
        rows, columns = (a.ravel() for a in np.indices((camera.height_px, camera.width_px), dtype=np.float32))
        seen = eye.look(columns, rows)
        pose = drive.poses(np.array([epoch_gps_ns]))
        at, turned = pose.sensor(camera.mount, EYE)
        body = pose.ecef_from_body.as_matrix()[0]
        place = (at[0] - pose.position_ecef_m[0] + seen.point_m.astype(np.float64) @ turned[0].T) @ body
        self.place_body_m[epoch_gps_ns] = place.astype(np.float32).reshape(camera.height_px, camera.width_px, 3)
        return self.real(studio, drive, epoch_gps_ns, number)

    def at(self, epoch_gps_ns: int, pixel: Float64) -> Float64:
        """Return the places (n, 3) at pixels (n, 2), linear between four of them that lie on one surface, else NaN."""
        image = self.place_body_m[epoch_gps_ns].astype(np.float64)
        high = np.array(image.shape[1::-1]) - 2
        low = np.clip(np.floor(pixel).astype(int), 0, high)
        share = pixel - low
        corner = np.stack([image[low[:, 1] + j, low[:, 0] + i] for j in (0, 1) for i in (0, 1)], axis=1)
        across, down = share[:, :1], share[:, 1:]
        upper = corner[:, 0] * (1.0 - across) + corner[:, 1] * across
        lower = corner[:, 2] * (1.0 - across) + corner[:, 3] * across
        reach = np.linalg.norm(corner, axis=2)
        flat = np.ptp(reach, axis=1) < 0.1 * reach.min(axis=1)
        return np.where(flat[:, None], upper * (1.0 - down) + lower * down, np.nan)


def street(seed: int) -> Scene:
    """40 m of `street_with_cameras`: parked and moving cars, trees, no control, pictures of 640 × 400 pixels."""
    bare: dict[str, Any] = {name: [] for name in ("targets", "crosswalks", "patches", "cracks", "stains", "tyre_marks")}
    camera = {"width_px": 640, "height_px": 400, "focal_px": 490.0, "principal_px": (322.0, 198.2), "every_m": 2.0,
              "clock": {"offset_s": 0.0}, "mount": {"error": BORESIGHT}}  # fmt: skip
    return Scene.load("street_with_cameras").changed(
        seed=seed, length_m=40.0, road=bare, roadside={"targets": []}, camera=camera
    )


def figures(folder: Path) -> Iterator[Figure]:
    """Distances of lidar planes from what the rays of tie points truly meet."""
    for seed in SEEDS:
        seen = _Seen(simulated_camera.picture)
        with mock.patch.object(simulated_camera, "picture", seen.picture):
            file = simulate(street(seed), folder / str(seed)).survey_file
        file.write_text(file.read_text() + "\n[picture_ties]\n")
        outcomes = list[PictureOutcome]()

        def kept(*values: Any, into: list[PictureOutcome] = outcomes, real: Any = solution.outcome_of) -> Any:
            into.append(real(*values))
            return into[-1]

        with mock.patch.object(solution, "outcome_of", kept):
            run_stages(Session.open(file), [stage_named(name) for name in STAGES])
        yield from _scored(f"seed {seed}", outcomes[-1], seen)


def _scored(of: str, outcome: PictureOutcome, seen: _Seen) -> Iterator[Figure]:
    depths, measured = outcome.depths, outcome.measured
    assert depths is not None
    rows = depths.surfaces.measurement
    picture, pixel = measured.picture[rows], measured.pixel[rows]
    epochs = np.array(sorted(seen.place_body_m))
    place = np.full((rows.size, 3), np.nan)
    for k in np.unique(picture).tolist():
        here = picture == k
        nearest = epochs[np.argmin(np.abs(epochs - measured.exposures.epoch_gps_ns[k]))]
        assert abs(int(nearest) - int(measured.exposures.epoch_gps_ns[k])) < 1_000_000
        place[here] = seen.at(int(nearest), pixel[here])
    away = np.einsum("ni,ni->n", depths.surfaces.normal_body, place - depths.surfaces.point_body_m)
    known, counts = np.isfinite(away), depths.weight > 0.0
    used, left = np.abs(away[known & counts]), np.abs(away[known & ~counts])
    sigma = np.hypot(depths.surfaces.sigma_m, 0.03)[known & counts]
    same = used < EDGE_M
    yield Figure(
        f"{of}: depths that count, of those whose truth is known", float(used.size), "", float(rows.size), "all"
    )
    yield Figure(f"{of}: plane from the true surface, median", 1e3 * float(np.median(used)), "mm")
    yield Figure(f"{of}: the same within {EDGE_M:g} m, RMS", 1e3 * float(np.sqrt(np.mean(used[same] ** 2))), "mm")
    yield Figure(f"{of}: the same over σ, RMS", float(np.sqrt(np.mean((used / sigma)[same] ** 2))), "")
    yield Figure(f"{of}: on another surface, of those that count", 100.0 * float(np.mean(~same)), "%")
    if left.size:
        other = 100.0 * float(np.mean(left >= EDGE_M))
        yield Figure(f"{of}: on another surface, of the {left.size} that do not count", other, "%")
