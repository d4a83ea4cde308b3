"""The calibration object under the profilers: low boxes that the vehicle straddles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from roadscan.simulate import Scene, simulate, truth


def test_profilers_see_the_calibration_object(tmp_path: Path):
    off = {"on": False}
    yard = Scene.load("calibration_yard")
    scene = yard.changed(
        passes=[yard.passes[1].model_dump()],
        profilers={"spacing_m": 0.1, "readings": 150, "head_imus": None},
        lidar=off, sick=off, camera=off, imu=off, gnss=off, road={"texture": None},
    ).noiseless()  # fmt: skip
    folder = simulate(scene, tmp_path / "s", write_hits=True).folder
    known = truth.load(folder)
    objects = pq.read_table(known.objects_file).to_pandas()
    boxes = objects[objects.kind == "box"].set_index("object_id" if "object_id" in objects else "id")
    seen: dict[int, int] = {}
    for head in ("profiler_left", "profiler_right"):
        table = pq.read_table(known.hits_file("run-1", head))
        columns = {
            name: table.column(name).combine_chunks().flatten().to_numpy(zero_copy_only=False)
            for name in ("easting_m", "northing_m", "height_m", "object_id")
        }
        above = columns["height_m"] - known.height_m(columns["easting_m"], columns["northing_m"])
        road = columns["object_id"] == 0
        assert np.abs(above[road]).max() < 1e-6
        for number, box in boxes.iterrows():
            on_box = columns["object_id"] == number
            seen[number] = seen.get(number, 0) + int(on_box.sum())
            if not on_box.any():
                continue
            # Upright sides are hit below the top edge; the top is level at the height above the foot.
            level = columns["height_m"][on_box] - (
                box.height_m + scene.roadside.boxes[number - boxes.index[0]].height_m
            )
            assert level.max() < 1e-6
            assert np.mean(np.abs(level) < 1e-6) > 0.9
            away_e = columns["easting_m"][on_box] - box.easting_m
            away_n = columns["northing_m"][on_box] - box.northing_m
            described = scene.roadside.boxes[number - boxes.index[0]]
            heading = np.radians(scene.map.azimuth_deg + described.heading_deg)
            ahead = away_e * np.sin(heading) + away_n * np.cos(heading)
            right = away_e * np.cos(heading) - away_n * np.sin(heading)
            assert np.abs(ahead).max() < described.length_m / 2 + 1e-6
            assert np.abs(right).max() < described.width_m / 2 + 1e-6
    assert sum(count > 20 for count in seen.values()) >= 3
