"""Twenty metres of a shipped scene without errors, written as raw logs."""

from roadscan.simulate import Scene, simulate

scene = Scene.load("urban_street").changed(length_m=20.0, lidar={"divergence_deg": 0.0}, profilers={"spacing_m": 0.1})
scene = scene.changed(passes=[{"lane": 2}], sick={"on": False}, camera={"every_m": 15.0})
made = simulate(scene.noiseless(), "short-street", write_hits=True)
print(made.survey_file, made.profiles, made.returns)
