"""Response of a quarter car to longitudinal profiles, and its mean over any stretch.

International roughness index: travel of the golden car's suspension per metre of road, at 80 km/h.

Sources: World Bank Technical Paper 46 (Sayers, Gillespie, Paterson 1986: equations, parameters, start, check table);
Sayers, *On the calculation of IRI from longitudinal road profile* (1995: moving average of 250 mm). They are the
public descriptions behind ASTM E1926 and AASHTO R 43; the texts of those standards were not at hand, and compliance
with them is not claimed.

Ride number: the rating from 0 to 5 that road users would give, estimated from the profile.

RN = 5 · exp(−160 · PI), with the profile index PI the root mean square of the suspension's slope of a quarter car of
its own at 80 km/h, behind the moving average of 250 mm; of two wheel paths the squares of PI are averaged. Source:
Sayers and Karamihas, *Interpretation of Road Roughness Profile Data* (FHWA-RD-96-101, 1996), the public description
behind ASTM E1489. Neither text was at hand: parameters and formula are those that are generally quoted from them, no
published example was found to check against, and compliance is not claimed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.condition.kernels.quarter_car import QuarterCar, roll
from roadscan.condition.profiles.profiles import (
    COARSEST_M,
    GOLDEN_CAR,
    RULES,
    Breaks,
    breaks_of,
    fault_of,
    heights_of,
    quarter_car,
    rules_at,
    stations_of,
    usual_step_m,
)
from roadscan.core.errors import ProfileError


class Segments(NamedTuple):
    """Beginnings and ends of segments."""

    from_m: Float64
    """(segments,) station of the beginning (m)."""
    to_m: Float64
    """(segments,) station of the end (m)."""


def segments_of(
    first_m: float, last_m: float, length_m: float | None = None, stations_m: Sequence[float] | None = None
) -> Segments:
    """Divide the way between two stations into segments.

    Parameters
    ----------
    length_m : of each segment from `first_m` on; the last one may be shorter. One segment in all by default.
    stations_m : ends of segments, in place of a length; what lies outside the profile is left out.

    Raises
    ------
    ProfileError
        where the length is not positive, both are given, or fewer than two stations meet the profile.
    """
    if length_m is not None and stations_m is not None:
        raise ProfileError("a length of segments and fixed stations", expected="one of them")
    if stations_m is not None:
        ends: Float64 = np.unique(np.asarray(stations_m, np.float64))
        if not np.isfinite(ends).all():
            raise ProfileError(f"a station {ends[~np.isfinite(ends)][0]}", expected="finite numbers, in metres")
        inside = (ends[1:] > first_m) & (ends[:-1] < last_m) if ends.size > 1 else np.zeros(0, bool)
        if not inside.any():
            raise ProfileError(
                f"{ends.size} stations, none of whose segments meets the profile",
                expected=f"two or more, between {first_m:g} and {last_m:g} m",
            )
        return Segments(ends[:-1][inside], ends[1:][inside])
    if length_m is None:
        return Segments(np.array([first_m]), np.array([last_m]))
    if not 0.0 < length_m < np.inf:
        raise ProfileError(f"segments of {length_m:g} m", expected="a finite length above 0 m")
    # A remainder of less than a millionth of a segment is rounding.
    count = max(1, int(np.ceil((last_m - first_m) / length_m - 1e-6)))
    ends = np.asarray(first_m + length_m * np.arange(count + 1), np.float64)
    ends[-1] = last_m
    return Segments(ends[:-1], ends[1:])


Note: TypeAlias = Literal["start", "gap", "jump", "step", "uneven", "short"]
NOTES: Final[tuple[Note, ...]] = get_args(Note)
"""Possible words of a segment's note, in their order."""


@dataclass(frozen=True)
class Ride:
    """Response of a quarter car to profiles that share their stations."""

    x_m: Float64
    """(n,) stations (m)."""
    response_m: Float64
    """(profiles, n) integral of the suspension's |slope|, or of its square, from the first sample on (m)."""
    measured_m: Float64
    """(profiles, n) length rolled over from the first sample on (m); gaps do not count."""
    breaks: tuple[Breaks, ...]
    """Gaps and jumps of each profile."""
    faults: tuple[str, ...]
    """Reason why a profile can have no index; empty where it can."""
    even: bool
    """Whether its stations are evenly spaced, as ASTM E1926 takes them."""

    def means(self, segments: Segments, least_share: float = 0.5) -> tuple[Float64, Float64]:
        """Return means of the response over segments, and the share of each segment that was rolled over.

        Returns
        -------
        (profiles, segments) twice. The mean is NaN where less than `least_share` of a segment was rolled over, and of
        profiles with a fault.
        """
        shape = (len(self.faults), segments.from_m.size)
        means, shares = np.full(shape, np.nan), np.zeros(shape)
        for row, fault in enumerate(self.faults):
            if fault:
                continue
            felt, rolled = self._over(self.response_m[row], segments), self._over(self.measured_m[row], segments)
            shares[row] = rolled / (segments.to_m - segments.from_m)
            enough = (shares[row] >= least_share) & (rolled > 0.0)
            means[row, enough] = felt[enough] / rolled[enough]
        return means, np.minimum(shares, 1.0)

    def notes(self, segments: Segments, nominal_m: float | None = None) -> list[list[str]]:
        """Return notes on each profile's segments, as words separated by commas; empty where there is nothing.

        `start`: the car begins in it, so its first 11 m depend on how it begins. `gap`: more than half a metre was not
        measured, or more than a foot of it is missing. `jump`: a step that no road has was left out. `step`: one of
        more than 0.1 m was kept. `uneven`: stations are not evenly spaced. `short`: less than `nominal_m` long.
        """
        return [[self._note(row, k, segments, nominal_m) for k in range(segments.from_m.size)]
                for row in range(len(self.faults))]  # fmt: skip

    def accuracy_class(self, segments: Segments) -> npt.NDArray[np.int64]:
        """Return (segments,) class of the World Bank by the widest step of a segment: 1 to 0.25 m, 2 to 0.5 m.

        The class does not depend on the accuracy of the heights.
        """
        wide = np.sort(np.concatenate([broken.wide_m for broken in self.breaks]))
        first, behind = (np.searchsorted(wide, ends) for ends in segments)
        return np.where(behind > first, 2, 1)

    def _over(self, sums: Float64, segments: Segments) -> Float64:
        """Return differences of sums over segments."""
        return np.interp(segments.to_m, self.x_m, sums) - np.interp(segments.from_m, self.x_m, sums)

    def _note(self, row: int, k: int, segments: Segments, nominal_m: float | None) -> str:
        begin, end, broken = segments.from_m[k], segments.to_m[k], self.breaks[row]
        starts = (self.x_m[:1], broken.gap_to_m, broken.jump_m)
        ends = Segments(segments.from_m[k : k + 1], segments.to_m[k : k + 1])
        missing_m = end - begin - float(self._over(self.measured_m[row], ends)[0])
        told: dict[Note, bool] = {
            "start": any(bool(((at + RULES.start_m > begin) & (at < end)).any()) for at in starts),
            "gap": bool(((broken.gap_from_m < end) & (broken.gap_to_m > begin)).any()) or missing_m > COARSEST_M,
            "jump": bool(((broken.jump_m >= begin) & (broken.jump_m <= end)).any()),
            "step": bool(((broken.severe_m >= begin) & (broken.severe_m <= end)).any()),
            "uneven": not self.even,
            "short": nominal_m is not None and bool(end - begin < nominal_m * (1.0 - 1e-6)),
        }
        return ", ".join(word for word, said in told.items() if said)


def ride(x_m: npt.ArrayLike, height_m: npt.ArrayLike, car: QuarterCar = GOLDEN_CAR, *, squared: bool = False) -> Ride:
    """Return the response of a quarter car to profiles of any spacing up to a foot, regular or not.

    The state passes from sample to sample by the exact solution of the equations of motion. The car begins at rest on
    the mean slope of the first 11 m, and so it does behind each gap of more than 0.5 m and each jump of more than
    0.5 m; pieces of less than 11 m are left out.

    Parameters
    ----------
    x_m : (n,) stations, ascending (m).
    height_m : (n,) or (profiles, n) heights; NaN where there is none (m).
    squared : the square of the suspension's slope is summed up in place of its absolute value.

    Raises
    ------
    ProfileError
        where the stations do not ascend, or heights do not fit them. A profile that cannot be judged has a fault.
    """
    x = stations_of(x_m)
    heights = heights_of(height_m, x.size)
    response, measured = np.empty_like(heights), np.empty_like(heights)
    usual_m = usual_step_m(x)
    roll(x, heights, car, rules_at(usual_m), squared, response, measured)
    return Ride(
        x,
        response,
        measured,
        tuple(breaks_of(x, row, RULES) for row in heights),
        tuple(fault_of(x, row, RULES) for row in heights),
        bool(np.isfinite(usual_m)),
    )


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
