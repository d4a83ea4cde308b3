"""Ride number: the rating from 0 to 5 that road users would give, estimated from the profile.

RN = 5 · exp(−160 · PI), with the profile index PI the root mean square of the suspension's slope of a quarter car of
its own at 80 km/h, behind the moving average of 250 mm; of two wheel paths the squares of PI are averaged. Source:
Sayers and Karamihas, *Interpretation of Road Roughness Profile Data* (FHWA-RD-96-101, 1996), the public description
behind ASTM E1489. Neither text was at hand: parameters and formula are those that are generally quoted from them, no
published example was found to check against, and compliance is not claimed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.profiles.quarter_car import quarter_car
from roadscan.condition.profiles.ride import Ride, ride
from roadscan.condition.profiles.segments import Segments

RIDE_NUMBER_CAR = quarter_car(k1=5120.0, k2=390.0, c=17.0, mu=0.036)
"""The car of the ride number."""


class RideNumber(NamedTuple):
    """Ride numbers of segments."""

    ride_number: Float64
    """(segments,) from 0 to 5; NaN where less than half of a segment was measured."""
    profile_index: Float64
    """(profiles, segments) PI, a slope."""
    measured_share: Float64
    """(profiles, segments) share of the segment that was measured."""


def ride_number_ride(x_m: npt.ArrayLike, height_m: npt.ArrayLike) -> Ride:
    """Return the ride of this index's car; parameters and errors as :func:`roadscan.condition.profiles.ride.ride`."""
    return ride(x_m, height_m, RIDE_NUMBER_CAR, squared=True)


def ride_number_of(on: Ride, segments: Segments) -> RideNumber:
    """Return the ride number of one wheel path, or of several together, from the ride of its car."""
    squares, shares = on.means(segments)
    return RideNumber(ride_number(np.sqrt(squares)), np.sqrt(squares), shares)


def ride_number(profile_index: Float64) -> Float64:
    """Return the ride number (k,) of wheel paths together, from their profile indices (paths, k)."""
    rating: Float64 = 5.0 * np.exp(-160.0 * np.sqrt(np.mean(profile_index**2, axis=0)))
    return rating
