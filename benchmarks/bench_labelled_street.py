"""Figures of the labelled street from what ``roadscan run`` wrote with default settings.

All sweeps of the recording, its first half, its second half, and every other sweep, each a survey of its own. Weights
and limits may have been looked at on the first half; the second is only scored.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks import street_scores as scores
from benchmarks.asset_scores import calibration_error, errors_of_exact
from benchmarks.labelled_street import LabelledStreet, labelled_street, recording_folder
from benchmarks.settings import bench_folder
from benchmarks.timing import Figure
from roadscan.assets import classes

PARTS: Final = {"all sweeps": range(8), "sweeps 0–3": range(4), "sweeps 4–7": range(4, 8)}
HALVES: Final = {"even": range(0, 8, 2), "odd": range(1, 8, 2)}


def figures(folder: Path) -> Iterator[Figure]:
    """Each part against its labels, and both halves against one another."""
    recording = recording_folder()
    for name, sweeps in PARTS.items():
        street = labelled_street(recording, bench_folder(folder) / name.replace(" ", "-"), sweeps)
        yield from of_street(name, street)
    halves = [labelled_street(recording, bench_folder(folder) / name, own) for name, own in HALVES.items()]
    for what, value in scores.apart_in_sigmas(*halves).items():
        yield Figure(f"even and odd sweeps, {what}", value, "σ RMS", 1.5, "the bar")


def of_street(name: str, street: LabelledStreet) -> Iterator[Figure]:
    """All measures of one survey."""
    yield Figure(f"{name}: ground, IoU", scores.ground_iou(street), "", 0.965, "the bar")
    walls = scores.iou_of_class(street, (scores.BUILDING,), classes.BUILDING)
    yield Figure(f"{name}: buildings, IoU", walls, "")
    leaves = scores.iou_of_class(street, (scores.VEGETATION, scores.TRUNK), *classes.VEGETATION)
    yield Figure(f"{name}: vegetation with its trunks, IoU", leaves, "")
    edges = scores.kerbs(street)
    yield Figure(f"{name}: kerbs of 5 cm, complete", edges.recall, "", 0.85, "the bar")
    yield Figure(f"{name}: kerbs of 5 cm, correct", edges.precision, "", 0.85, "the bar")
    terrain = scores.kerbs(street, (scores.SIDEWALK, scores.TERRAIN))
    yield Figure(f"{name}: kerbs of 5 cm, correct where terrain counts, too", terrain.precision, "")
    yield Figure(f"{name}: markings, F1 of cells of 0.1 m", scores.markings_f1(street), "", 0.72, "the bar")
    posts = scores.poles_and_trunks(street)
    yield Figure(f"{name}: poles and trunks ({posts.wanted}), recall", posts.recall, "", 0.88, "the bar")
    yield Figure(f"{name}: poles and trunks ({posts.judged}), precision", posts.precision, "", 0.88, "the bar")
    found, wanted, false = scores.signs(street)
    yield Figure(f"{name}: strong signs found", found, "", wanted, "that stand there")
    yield Figure(f"{name}: false signs", false, "", 0.0, "the bar")
    lost = scores.share_of_class(street, scores.TRUNK, classes.VEHICLE)
    yield Figure(f"{name}: returns of trunks among vehicles", lost, "", 0.02, "the bar")
    fences = scores.iou_of_class(street, (scores.FENCE,), classes.FENCE)
    yield Figure(f"{name}: fences, IoU", fences, "", 0.4, "the bar")
    judged = scores.judged_objects(street)
    error = calibration_error(judged)
    yield Figure(f"{name}: calibration error of {len(judged)} objects", error, "", 0.08, "the bar")
    chance = errors_of_exact(np.array([one.probability for one in judged]))
    yield Figure(f"{name}: the same of exact probabilities, mean", float(chance.mean()), "")
    yield Figure(f"{name}: the same of exact probabilities, 95 % of draws below", float(np.quantile(chance, 0.95)), "")
    yield Figure(f"{name}: the same of exact probabilities, draws above the error", float((chance > error).mean()), "")
