"""Search of a painted control target in the intensities of one pass.

Places that look like the target (:mod:`candidates`) are tested by the shares of paint, outline and clear road that
it should have (:mod:`evidence`), its shape is fitted to the readings (:mod:`fit`), and the shares are tested again at
the fitted place. One place that passes is the target; two are ambiguous. Its height is that of a surface through the
readings at its centre (:mod:`heights`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roadscan.adjust.targets.candidates import Candidate, candidates
from roadscan.adjust.targets.evidence import Evidence, evidence
from roadscan.adjust.targets.fit import ShapeFit, first_levels, fit_radius_m, fit_shape
from roadscan.adjust.targets.heights import height_at
from roadscan.adjust.targets.pictures import picture_of
from roadscan.adjust.targets.settings import TargetSettings
from roadscan.adjust.targets.shapes import Cells, Chequered, cells_of, spacing_m
from roadscan.adjust.targets.values import ExpectedTarget, Status, TargetFind, TargetPicture, TargetReadings
from roadscan.compute.array_types import Float64

_GRID_CELLS = 24
"""Cells of the search's grid along the size of a shape, where readings are dense enough."""
_FIT_CELLS = 75
"""Cells of the fit along the size."""
_LEAST_READINGS = 8
"""Least number of readings along the size: with fewer there is no outline."""
_OVERLAP = 0.9
"""Two targets are at least this share of the size apart."""
_WANDERS = 0.25
"""Farthest that a fit may end from its start, as a share of the size."""
_EASED = 0.6
"""Share of the limits that a candidate must reach before the fit."""


@dataclass(frozen=True)
class _Held:
    """A place that passes as the target."""

    fit: ShapeFit
    evidence: Evidence


def find_target(points: TargetReadings, expected: ExpectedTarget, settings: TargetSettings) -> TargetFind:
    """Returns the target near its stated place, or why it is not found."""
    return _Search(points, expected, settings).find()


class _Search:
    """Readings around the stated place, and the criteria of the search."""

    def __init__(self, points: TargetReadings, expected: ExpectedTarget, settings: TargetSettings) -> None:
        self.points, self.expected, self.settings, self.shape = points, expected, settings, expected.shape
        self.origin_m = np.array([expected.easting_m, expected.northing_m])
        place = np.stack([points.easting_m, points.northing_m], axis=-1) - self.origin_m
        near = np.hypot(*place.T) <= settings.search_radius_m + 1.2 * fit_radius_m(self.shape)
        self.place_m = place[near]
        self.value = points.intensity[near].astype(np.float64)
        self.size_m = 2.0 * self.shape.half_m

    def find(self) -> TargetFind:
        """Returns the target, or why there is none."""
        spacing = spacing_m(self.place_m, self.size_m / 4) if self.value.size else float("inf")
        if self.value.size < _LEAST_READINGS**2:
            return self._not("missed", f"{self.value.size} readings near its stated place")
        if spacing > self.size_m / _LEAST_READINGS:
            return self._not("missed", f"readings lie {spacing * 1e3:.0f} mm apart, too far for its outline")
        held, fault = self._held(spacing)
        if not held:
            return self._not("missed", fault)
        if len(held) > 1:
            away = float(np.hypot(*(held[0].fit.centre_m - held[1].fit.centre_m)))
            return self._found(held, "doubled", f"{len(held)} places look like it, {away:.2f} m apart")
        return self._found(held, *self._moved(held[0].fit))

    def _held(self, spacing: float) -> tuple[list[_Held], str]:
        """Returns places that pass, the best first, and why the likeliest one did not."""
        settings, cell = self.settings, max(1.25 * spacing, self.size_m / _GRID_CELLS)
        coarse = cells_of(self.place_m, self.value, cell)
        likely = candidates(
            coarse, cell, self.shape, settings.search_radius_m, settings.least_likeness, settings.most_candidates
        )
        held: list[_Held] = []
        faults = []
        for candidate in likely:
            if any(self._overlap(one.fit.centre_m, candidate.centre_m) for one in held):
                continue
            found, fault = self._examined(candidate, spacing, cell)
            faults.append(fault)
            if found is not None and not any(self._overlap(o.fit.centre_m, found.fit.centre_m) for o in held):
                held.append(found)
        held.sort(key=lambda one: -one.evidence.score)
        return held, faults[0] if faults else "nothing near its stated place looks like it"

    def _overlap(self, first_m: Float64, second_m: Float64) -> bool:
        """Returns whether two places are too close to be two targets."""
        return bool(np.hypot(*(first_m - second_m)) < _OVERLAP * self.size_m)

    def _examined(self, candidate: Candidate, spacing: float, cell: float) -> tuple[_Held | None, str]:
        """Returns a fitted candidate, or its fault."""
        settings, shape, fine_m = self.settings, self.shape, self.size_m / _FIT_CELLS
        fine = self._cells_around(candidate.centre_m, fine_m)
        near = fine.within(candidate.centre_m, fit_radius_m(shape))
        threshold = first_levels(near, shape, candidate.centre_m).threshold
        rough = evidence(near, shape, candidate.centre_m, candidate.turn_rad, threshold, 1.5 * cell)
        if fault := rough.fault(settings, slack=_EASED):
            return None, fault
        fit = fit_shape(fine, shape, candidate.centre_m, candidate.turn_rad, max(spacing, fine_m))
        if fit is None or self._wandered(fit, candidate):
            return None, "no shape of its kind fits the readings"
        stands_out = fit.levels.contrast / max(fit.levels.noise, 1e-9)
        if stands_out < settings.least_contrast:
            return None, f"paint stands out by {stands_out:.1f} σ of the readings"
        if abs(fit.scale - 1.0) > settings.size_tolerance:
            return None, f"the shape there is {fit.scale * self.size_m:.3f} m across"
        near = fine.within(fit.centre_m, fit_radius_m(shape))
        shown = evidence(near, shape, fit.centre_m, fit.turn_rad, fit.levels.threshold, 0.5 * spacing)
        fault = shown.fault(settings)
        return (None, fault) if fault else (_Held(fit, shown), "")

    def _cells_around(self, centre_m: Float64, cell_m: float) -> Cells:
        """Returns small cells of all that a fit from a place can need."""
        reach = fit_radius_m(self.shape) + _WANDERS * self.size_m
        near = np.all(np.abs(self.place_m - centre_m) <= reach, axis=1)
        return cells_of(self.place_m[near], self.value[near], cell_m)

    def _wandered(self, fit: ShapeFit, candidate: Candidate) -> bool:
        """Returns whether a fit left its candidate, or the searched area."""
        away = np.hypot(*(fit.centre_m - candidate.centre_m))
        return bool(away > _WANDERS * self.size_m or np.hypot(*fit.centre_m) > self.settings.search_radius_m)

    def _moved(self, fit: ShapeFit) -> tuple[Status, str]:
        expected, points, settings = self.expected, self.points, self.settings
        variance = expected.sigma_horizontal_m**2 + points.sigma_horizontal_m**2 + settings.sigma_paint_m**2
        covariance = fit.covariance_m2 + variance * np.eye(2)
        away = fit.centre_m
        sigmas = float(np.sqrt(away @ np.linalg.solve(covariance, away)))
        if sigmas <= settings.moved_sigmas:
            return "found", ""
        return "moved", f"found {np.hypot(*away):.3f} m from its stated place, {sigmas:.1f} σ"

    def _found(self, held: Sequence[_Held], status: Status, why_not: str) -> TargetFind:
        fit, shown = held[0].fit, held[0].evidence
        easting, northing = (self.origin_m + fit.centre_m).tolist()
        height = height_at(self.points, easting, northing, self.settings)
        turned = isinstance(self.shape, Chequered)
        return TargetFind(
            name=self.expected.name,
            status=status,
            why_not=why_not,
            easting_m=easting,
            northing_m=northing,
            height_m=height.height_m,
            covariance_m2=fit.covariance_m2 + self.settings.sigma_paint_m**2 * np.eye(2),
            sigma_height_m=height.sigma_m,
            count=fit.count,
            contrast=fit.levels.contrast,
            noise=fit.levels.noise,
            score=shown.score,
            diameter_m=fit.scale * self.size_m,
            azimuth_rad=-fit.turn_rad % np.pi if turned else 0.0,
            others_m=np.array([self.origin_m + one.fit.centre_m for one in held[1:]]).reshape(-1, 2),
            picture=self._picture(held),
        )

    def _not(self, status: Status, why_not: str) -> TargetFind:
        nan = float("nan")
        return TargetFind(
            name=self.expected.name, status=status, why_not=why_not, easting_m=nan, northing_m=nan, height_m=nan,
            covariance_m2=np.full((2, 2), nan), sigma_height_m=nan, count=0, contrast=nan, noise=nan, score=0.0,
            diameter_m=nan, azimuth_rad=nan, others_m=np.zeros((0, 2)), picture=self._picture([]),
        )  # fmt: skip

    def _picture(self, held: Sequence[_Held]) -> TargetPicture:
        """Returns an image of the target's surroundings; where it is missed or doubled, of the whole search."""
        wide = self.settings.search_radius_m + self.shape.reach_m
        middle, half = np.zeros(2), wide
        if len(held) == 1:
            middle, half = held[0].fit.centre_m, min(2.0 * self.shape.reach_m, wide)
        outlines = np.array([[*(o.fit.centre_m - middle), o.fit.turn_rad, o.fit.scale] for o in held])
        return picture_of(
            self.place_m - middle, self.value, half, self.shape, outlines.reshape(-1, 4), self.origin_m + middle
        )
