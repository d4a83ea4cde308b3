"""The stage `surfaces`: seconds of a core a tile, part by part, of a triangulation pair and of a SICK.

The pair's cells of 5 mm are smoothed, the SICK's readings reconstructed on 2 × 3 cm. Tiles, cells and footprints are
made before, uncounted; of each survey the fullest tile is taken, and the best of three runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import surveys
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure, thread_seconds
from roadscan.core.survey import Survey
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.store.store import Store
from roadscan.surface.reconstruction import surface_of
from roadscan.surface.stage import plan_surface_work
from roadscan.surface.tasks.surface_plan import SurfacePlan
from roadscan.surface.tasks.surfaces import compute_surfaces, source_of
from roadscan.survey.run import run_stages

PAIR_M, SICK_S = 5.0, 60.0
_PIECES = ("crack_pieces", "pothole_pieces")
_SHOWN = ("surface", "surface_mesh", "surface_pictures")


def figures(folder: Path) -> Iterator[Figure]:
    """Both surveys."""
    kept = bench_folder(folder)
    cells = {"method": "cells", "sigma_m": 0.0005}
    yield from _measured("pair, 5 mm", surveys.pair(kept, PAIR_M).file, folder / "pair", cells, (*_SHOWN, *_PIECES))
    points = {"method": "points", "sigma_m": 0.006, "cell_m": (0.02, 0.03)}
    yield from _measured("SICK, 2 × 3 cm", surveys.sick(kept, SICK_S).file, folder / "sick", points, _SHOWN)


def _measured(name: str, file: Path, folder: Path, surface: dict[str, Any], make: tuple[str, ...]) -> Iterator[Figure]:
    survey = _changed(Survey.load(file), surface, make)
    store = Store(str(folder), survey.config.id)
    run_stages(Session(survey, store, Inline()), [s for s in stages() if s.name not in ("surfaces", "products")])
    planned = plan_surface_work(Session(survey, store)).planned
    if planned is None:
        return
    held = {t: r.figures()["cells"] for t, r in planned.cells.items()}
    task = planned.task((max(planned.keys, key=lambda t: held.get(t, 0)),))
    (tile,) = task.block.tiles
    best = lambda work: thread_seconds(work, 3)  # noqa: E731
    patch = source_of(task).patch(tile, None)
    made = surface_of(tile, patch, task.grid)
    cells = int(np.count_nonzero(made.origin[made.inner]))
    yield Figure(f"{name}: cells of the tile that hold a height", cells / 1e6, "M")
    yield Figure(f"{name}: heights before smoothing", best(lambda: source_of(task).patch(tile, None)), "s")
    yield Figure(f"{name}: smoothing and filling", best(lambda: surface_of(tile, patch, task.grid)), "s")
    for wanted in planned.products:
        path = folder / f"one{wanted.product.suffix_for(wanted.options)}"
        yield Figure(f"{name}: {wanted.product.name}", best(_writing(wanted, made, planned, path)), "s")
    whole = best(lambda: compute_surfaces(task))
    yield Figure(f"{name}: the tile as a whole", whole, "s", None, f"{1e6 * whole / cells:.2f} µs a cell")


def _writing(wanted: Any, made: Any, planned: SurfacePlan, path: Path) -> Callable[[], None]:
    return lambda: wanted.product.write(made, wanted.options, planned.tiles.context, path)


def _changed(survey: Survey, surface: dict[str, Any], make: tuple[str, ...]) -> Survey:
    values = survey.config.model_dump()
    values |= {"rig": survey.rig.model_dump(), "surface": surface, "products": {"make": list(make), "options": {}}}
    return Survey.parse(values, folder=survey.folder)
