"""The stage `assets` on a simulated town street: returns a second of a core, by part and by kind.

Returns of a halo are looked at as often as squares need them; a rate counts each return of the street once.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from benchmarks.timing import Figure
from roadscan.assets.intensity import calibrated_scene, gains_of, intensity_sample
from roadscan.assets.kind import asset_kinds
from roadscan.assets.scene import Statistics
from roadscan.assets.tasks.load_returns import load_squares, scene_of
from roadscan.assets.tasks.plan import AssetPlan, plan_assets, wanted_kinds
from roadscan.footprints.footprints import footprints_of
from roadscan.georeference.plan.plan import plan_of
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene as Street
from roadscan.simulate import simulate
from roadscan.survey.run import run_stages

LENGTH_M = 60.0
OFF = {"on": False}


def figures(folder: Path) -> Iterator[Figure]:
    """All parts together, then each."""
    session = simulated(folder)
    plan = plan_assets(plan_of(session), footprints_of(session))
    returns = sum(f.rows for _, files in plan_of(session).sources for f in files)
    search(plan)  # what is compiled, and what the disk holds, does not count
    seconds, pieces = search(plan)
    seconds["join"] = join(plan, pieces)
    whole = sum(seconds.values())
    yield Figure(
        "assets, all parts and kinds", returns / whole / 1e6, "M returns/s of a core", 1.0, "the bar: 2 on two cores"
    )
    for name, spent in seconds.items():
        yield Figure(f"assets, {name}", 1e9 * spent / returns, "ns/return")


def simulated(folder: Path) -> Session:
    """A drive of the town street with its lidar, as far as footprints."""
    scene = Street.load("urban_street").changed(
        length_m=LENGTH_M, passes=[{"lane": 2}], profilers=OFF, sick=OFF, camera=OFF, imu=OFF, gnss=OFF, encoder=OFF
    )
    file = simulate(scene, folder / "street").survey_file
    file.write_text(file.read_text() + "\n[assets]\n")
    session = Session.open(file)
    run_stages(session, [stage_named(name) for name in ("ingest", "navigate", "footprints")])
    return Session.open(file)


def search(plan: AssetPlan) -> tuple[dict[str, float], dict[str, list[pa.Table]]]:
    """Processor time (s) of each part over all squares, and the pieces of each kind."""
    seconds: dict[str, float] = {}
    pieces: dict[str, list[pa.Table]] = {}
    kinds = [(one.kind, one.options) for one in wanted_kinds(plan.config)]

    def spent(part: str, began: float) -> float:
        now = time.process_time()
        seconds[part] = seconds.get(part, 0.0) + now - began
        return now

    gains: pa.Table | None = None
    for squares in plan.blocks(list(plan.keys)):
        began = time.process_time()
        for one in load_squares(plan.load(squares), list(dict.fromkeys(plan.together[s] for s in squares))):
            began = spent("loading", began)
            if not len(one.returns):
                continue
            scene = scene_of(plan.grid, one, plan.config.ground, Statistics())
            began = spent("scenes", began)
            if gains is None:
                gains, began = gains_of([intensity_sample(scene)]), time.process_time()
            scene = calibrated_scene(scene, gains)
            began = spent("intensity", began)
            for square in one.squares:
                own = scene.of_tile(plan.grid.box_from(one.returns.corner_m, square))
                for kind, options in kinds:
                    pieces.setdefault(kind.name, []).append(kind.evidence(own, options).pieces)
                    began = spent(kind.name, began)
    return seconds, pieces


def join(plan: AssetPlan, pieces: dict[str, list[pa.Table]]) -> float:
    """Processor time (s) that joining takes."""
    began = time.process_time()
    found: dict[str, list[object]] = {}
    for one in wanted_kinds(plan.config):
        others = {name: found.get(name, []) for name in one.kind.after}
        kind = asset_kinds()[one.name]
        rows = pa.concat_tables([kind.piece_schema.empty_table(), *pieces.get(one.name, ())]).combine_chunks()
        found[one.name] = list(kind.objects(kind.joined(rows), one.options, others))  # type: ignore[arg-type]
    return time.process_time() - began
