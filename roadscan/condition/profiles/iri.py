"""International roughness index: travel of the golden car's suspension per metre of road, at 80 km/h.

Sources: World Bank Technical Paper 46 (Sayers, Gillespie, Paterson 1986: equations, parameters, start, check table);
Sayers, *On the calculation of IRI from longitudinal road profile* (1995: moving average of 250 mm). They are the
public descriptions behind ASTM E1926 and AASHTO R 43; the texts of those standards were not at hand, and compliance
with them is not claimed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.profiles.profiles import heights_of
from roadscan.condition.profiles.ride import Ride, ride
from roadscan.condition.profiles.segments import Segments

LOCAL_M = 7.62
"""Length of the rolling mean that shows localised roughness (25 feet; m)."""


class SegmentIri(NamedTuple):
    """IRI of segments, of several profiles."""

    iri_m_per_km: Float64
    """(profiles, segments); NaN where less than half of a segment was measured."""
    measured_share: Float64
    """(profiles, segments) share of the segment that was measured."""


def iri_of(on: Ride, segments: Segments) -> SegmentIri:
    """Return the IRI of segments, from the golden car's ride (:func:`roadscan.condition.profiles.ride.ride`)."""
    means, shares = on.means(segments)
    return SegmentIri(1e3 * means, shares)


def rolling_iri(on: Ride, length_m: float = LOCAL_M) -> Float64:
    """Return the IRI over `length_m` around each sample (profiles, n); NaN within half of it of the ends.

    The continuous report of localised roughness, as AASHTO R 54 has it with 7.62 m (public descriptions).
    """
    half = 0.5 * length_m
    found = np.full(on.response_m.shape, np.nan)
    inside = (on.x_m - half >= on.x_m[0] - 1e-9) & (on.x_m + half <= on.x_m[-1] + 1e-9)
    around = Segments(on.x_m[inside] - half, on.x_m[inside] + half)
    found[:, inside] = iri_of(on, around).iri_m_per_km
    return found


def mean_roughness_index(iri_left_m_per_km: Float64, iri_right_m_per_km: Float64) -> Float64:
    """Return the MRI (m/km): the mean of the IRI of two wheel paths (AASHTO R 43, public descriptions)."""
    return 0.5 * (iri_left_m_per_km + iri_right_m_per_km)


def half_car_ride(x_m: npt.ArrayLike, left_m: npt.ArrayLike, right_m: npt.ArrayLike) -> Ride:
    """Return the golden car's ride on the mean of two wheel paths; its IRI is the half-car roughness index, HRI.

    Bumps of one side that are dips of the other cancel, so HRI ≤ MRI (Sayers 1989, *Two quarter-car models for
    defining road roughness: IRI and HRI*).
    """
    samples = np.size(x_m)
    return ride(x_m, 0.5 * (heights_of(left_m, samples) + heights_of(right_m, samples)))
