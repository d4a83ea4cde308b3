"""Questions to the truth of the survey in the folder short-street."""

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from roadscan.simulate import truth

known = truth.load("short-street")

# Height and intensity anywhere on the road, by map coordinates; NaN beside it.
easting, northing, heading_rad = known.surface.place(station_m=np.array([5.0, 10.0]), offset_m=np.array([1.6, -1.0]))
print(known.height_m(easting, northing), known.intensity(easting, northing))
print(known.station_offset_m(easting, northing))

# Where the vehicle was, and where its camera.
poses = pq.read_table(known.trajectory_file("run-1"))
pictures = pq.read_table(known.camera_file("run-1"))
print(poses.num_rows, pictures["file"].to_pylist())

# Everything beside the road, and what of it the lidar met.
objects = pq.read_table(known.objects_file)
returns = pq.read_table(known.hits_file("run-1", "lidar"))
met = pc.value_counts(returns["object_id"]).to_pylist()
kinds = dict(zip(objects["object_id"].to_pylist(), objects["kind"].to_pylist(), strict=True)) | {0: "road"}
for one in sorted(met, key=lambda one: -one["counts"])[:5]:
    print(f"{one['counts']:>8,} returns of {kinds[one['values']]} {one['values']}")
