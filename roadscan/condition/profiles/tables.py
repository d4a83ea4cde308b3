"""Indices of profiles as tables, for Python and the command line.

Mean profile depth of texture profiles, after the steps of ISO 13473-1:2019.

The depth of a segment of 100 mm is the mean of the peaks of its two halves above its mean; MPD is the mean of the
depths of valid segments. How a profile is made ready, and what that was taken from, stands in
:mod:`roadscan.condition.profiles.texture`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64
from roadscan.compute.arrays import runs_of
from roadscan.condition.profiles.profile_faults import NOTABLE, PROFILE_STEPS, SoundHeights, sound_heights, too_high_by
from roadscan.condition.profiles.profiles import heights_of, raise_fault, stations_of
from roadscan.condition.profiles.ride import (
    LOCAL_M,
    NOTES,
    Ride,
    Segments,
    half_car_ride,
    iri_of,
    mean_roughness_index,
    ride,
    ride_number_of,
    ride_number_ride,
    rolling_iri,
    segments_of,
)
from roadscan.condition.profiles.texture import TextureSegment, TextureSettings, rms_texture_mm, texture_segments
from roadscan.core.errors import ProfileError
from roadscan.core.witness import Finding

if TYPE_CHECKING:
    import pandas as pd


class ProfileTable(NamedTuple):
    """Figures of a profile, and what was noticed in it."""

    columns: dict[str, Sequence[Any] | npt.NDArray[Any]]
    """Values by column, a row a stretch."""
    findings: list[Finding]
    """What was left out, and what is doubtful."""

    def frame(self) -> pd.DataFrame:
        """Return the table for Python, with the findings in `attrs["findings"]`."""
        import pandas as pd  # 0.15 s, which the command line goes without

        table = pd.DataFrame(self.columns)
        table.attrs["findings"] = self.findings
        return table


FLATTEST_M_PER_KM = 0.1
"""Least IRI of a road: a lower one was measured in another unit, or is no road."""
ROUGHEST_M_PER_KM = 30.0
"""Largest IRI of a road: on the World Bank's scale, tracks with erosion gullies end at 20 m/km."""
FINEST_STEP_M = 5e-5
"""Finer steps of heights do not affect roughness: class 1 of the smoothest roads takes 0.125 mm."""
FINEST_STEP_MM = 0.01
"""Finer steps of heights do not affect texture."""
FLATTEST_MM = 0.02
"""Least mean profile depth of a road."""


def iri(
    x_m: npt.ArrayLike,
    height_m: npt.ArrayLike,
    *,
    segment_m: float | None = None,
    stations_m: Sequence[float] | None = None,
    names: Sequence[str] = (),
) -> pd.DataFrame:
    """Compute IRI and ride number of one profile, or of several that share their stations.

    Parameters
    ----------
    x_m : (n,) stations, ascending, at any spacing up to a foot, regular or not (m).
    height_m : (n,) or (profiles, n) heights; NaN where there is none (m).
    segment_m : length of segments; one row for all by default (m).
    stations_m : ends of segments, in place of a length (m).
    names : of the profiles, for the columns; 1, 2 … by default.

    Returns
    -------
    A row a segment: from_m, to_m, iri_m_per_km (of several profiles one column each, `iri_NAME_m_per_km`; of two also
    mri_m_per_km, their mean, and hri_m_per_km, the half car), ride_number, measured_share (the least of the profiles),
    accuracy_class (:meth:`roadscan.condition.profiles.ride.Ride.accuracy_class`; 3 where heights are too coarse) and
    note. Values are NaN where less than half of a segment was measured. Repeated heights and spikes are left out
    (:mod:`roadscan.condition.profiles.profile_faults`). Notes: `start`, `gap`, `jump`, `step`, `uneven`, `short` (see
    :meth:`roadscan.condition.profiles.ride.Ride.notes`); `stuck` and `spikes`, of which samples are left out; `coarse`,
    an IRI that is too high by over 5 % for the rounding of its heights; and `flat` or `wild`, an IRI so low or high
    that no road has it. `attrs["findings"]` says the same in sentences (:class:`roadscan.core.witness.Finding`).

    Raises
    ------
    ProfileError
        where stations do not ascend, or a profile cannot be judged: too coarse, too short, or no road.
    """
    return iri_table(x_m, height_m, segment_m=segment_m, stations_m=stations_m, names=names).frame()


def iri_table(
    x_m: npt.ArrayLike,
    height_m: npt.ArrayLike,
    *,
    segment_m: float | None = None,
    stations_m: Sequence[float] | None = None,
    names: Sequence[str] = (),
) -> ProfileTable:
    """Return what :func:`iri` does, as columns."""
    on, sound = _sound_ride(x_m, height_m)
    heights = np.stack([one.height_m for one in sound])
    parts = segments_of(on.x_m[0], on.x_m[-1], segment_m, stations_m)
    found, shares = iri_of(on, parts)
    columns: dict[str, Sequence[Any] | npt.NDArray[Any]] = {"from_m": parts.from_m, "to_m": parts.to_m}
    labels = list(names) or [str(k + 1) for k in range(len(heights))]
    for label, values in zip(labels, found, strict=True):
        columns["iri_m_per_km" if len(heights) == 1 else f"iri_{label}_m_per_km"] = values
    if len(heights) == 2:
        columns["mri_m_per_km"] = mean_roughness_index(found[0], found[1])
        columns["hri_m_per_km"] = iri_of(half_car_ride(on.x_m, heights[0], heights[1]), parts).iri_m_per_km[0]
    columns["ride_number"] = ride_number_of(ride_number_ride(on.x_m, heights), parts).ride_number
    columns["measured_share"] = shares.min(axis=0)
    rounding = np.stack([_rounding(on.x_m, one, parts, own) for one, own in zip(sound, found, strict=True)])
    coarse = np.atleast_1d((rounding > NOTABLE * found).any(axis=0))
    columns["accuracy_class"] = np.where(coarse, 3, on.accuracy_class(parts))
    columns["note"] = [
        ", ".join(filter(None, (note, *_left_out(on.x_m, sound, parts, k), "coarse" * bool(coarse[k]))))
        for k, note in enumerate(_joined(on, parts, segment_m, found))
    ]
    told = _findings(on.x_m, sound, labels)
    if coarse.any():
        told += [
            PROFILE_STEPS.finds(
                whose,
                f"its heights lie on steps of {1e3 * one.step_m:.3g} mm, and rounding alone makes its IRI too high by "
                f"some {np.nanmax(own):.2f} m/km where it is worst.",
            )
            for whose, one, own in zip(_whose(labels), sound, rounding, strict=True)
            if (own > NOTABLE * found).any()
        ]
    return ProfileTable(columns, told)


def localised_roughness(
    x_m: npt.ArrayLike, height_m: npt.ArrayLike, limit_m_per_km: float, *, length_m: float = LOCAL_M
) -> pd.DataFrame:
    """Return stretches where the rolling IRI of a profile is above a limit.

    Parameters
    ----------
    x_m, height_m : as of :func:`iri`; the mean of the rolling IRI of several profiles is taken.
    limit_m_per_km : the limit, such as 2.5 (m/km).
    length_m : length of the rolling mean (m).

    Returns
    -------
    A row a stretch: from_m, to_m, peak_station_m, peak_m_per_km and note: `step` where one of more than 0.1 m lies in
    it. A step of more than 0.5 m has a row without a peak and with the note `jump`: the car does not roll over it.
    """
    return localised_table(x_m, height_m, limit_m_per_km, length_m=length_m).frame()


def localised_table(
    x_m: npt.ArrayLike, height_m: npt.ArrayLike, limit_m_per_km: float, *, length_m: float = LOCAL_M
) -> ProfileTable:
    """Return what :func:`localised_roughness` does, as columns."""
    if not np.isfinite(limit_m_per_km):
        raise ProfileError(f"a limit of {limit_m_per_km} m/km", expected="a finite number")
    on, sound = _sound_ride(x_m, height_m)
    found = stretches_above(on.x_m, rolling_iri(on, length_m).mean(axis=0), limit_m_per_km)
    severe = np.concatenate([broken.severe_m for broken in on.breaks])
    half = 0.5 * length_m
    rows: list[tuple[float, float, float, float, str]] = []
    for one in found:
        stepped = bool(((severe >= one.from_m - half) & (severe <= one.to_m + half)).any())
        rows.append((one.from_m, one.to_m, one.peak_m, one.peak, "step" if stepped else ""))
    jumps = np.unique(np.concatenate([broken.jump_m for broken in on.breaks]))
    rows += [(at - half, at + half, at, np.nan, "jump") for at in jumps.tolist()]
    rows.sort(key=lambda row: row[0])
    names = ("from_m", "to_m", "peak_station_m", "peak_m_per_km")
    columns: dict[str, Sequence[Any] | npt.NDArray[Any]] = {
        name: np.array([row[k] for row in rows], float) for k, name in enumerate(names)
    }
    columns["note"] = [row[-1] for row in rows]
    return ProfileTable(columns, _findings(on.x_m, sound, [str(k + 1) for k in range(len(sound))]))


def mpd(
    x_m: npt.ArrayLike,
    height_m: npt.ArrayLike,
    *,
    segment_m: float | None = None,
    from_m: float | None = None,
    to_m: float | None = None,
    settings: TextureSettings | None = None,
) -> pd.DataFrame:
    """Compute mean profile depth and RMS texture of a texture profile.

    Parameters
    ----------
    x_m : (n,) stations, ascending, a sample each 0.5 mm or closer (m).
    height_m : (n,) heights, positive upwards; NaN where there is none (m).
    segment_m : length that a row is for, a multiple of 0.1 m; one row for all by default (m).
    from_m, to_m : only what lies between.
    settings : of the steps before the depth.

    Returns
    -------
    A row a stretch: from_m, to_m, mpd_mm, stdev_mm (of the depths of its segments of 100 mm), rms_mm, valid_segments,
    segments and note. Values are NaN where fewer than half of the segments are valid. Notes: `dropouts`, `spikes` and
    `jump`, each with the number of segments that were left out for it; `stuck`, with the number of segments in which
    heights that repeat themselves count as dropouts; `coarse`, a depth of which over 5 % is the rounding of heights;
    and `flat`, a depth that no road has. `attrs["findings"]` says the same in sentences.

    Raises
    ------
    ProfileError
        where stations do not ascend, or the profile is too coarse, too short or no texture.
    """
    return mpd_table(x_m, height_m, segment_m=segment_m, from_m=from_m, to_m=to_m, settings=settings).frame()


def mpd_table(
    x_m: npt.ArrayLike,
    height_m: npt.ArrayLike,
    *,
    segment_m: float | None = None,
    from_m: float | None = None,
    to_m: float | None = None,
    settings: TextureSettings | None = None,
) -> ProfileTable:
    """Return what :func:`mpd` does, as columns."""
    if segment_m is not None and not (0.1 <= segment_m < np.inf and abs((segment_m + 0.05) % 0.1 - 0.05) < 1e-7):
        raise ProfileError(f"stretches of {segment_m:g} m", expected="a multiple of the 0.1 m of a segment")
    x = stations_of(x_m)
    if heights_of(height_m, x.size).shape[0] != 1:
        raise ProfileError("several profiles", expected="one texture profile")
    sound = sound_heights(x, heights_of(height_m, x.size)[0], spikes=False)
    segments = texture_segments(x, sound.height_m, settings, from_m=from_m, to_m=to_m)
    again = (
        segments
        if 1e3 * sound.step_m < FINEST_STEP_MM
        else texture_segments(x, sound.rounded_again()[0], settings, from_m=from_m, to_m=to_m)
    )
    stretches = segments_of(segments[0].from_m, segments[-1].to_m, segment_m)
    rows, told = [], _findings(x, [sound], [""])
    stuck_m = x[sound.stuck]
    depths = (mean_profile_depths(own, stretches) for own in (segments, again))
    for first, last, depth, rounded in zip(*stretches, *depths, strict=True):
        inside = [one for one in segments if first - 1e-6 <= one.from_m < last - 1e-6]
        words = [word for one in inside for word in one.note.split(", ") if word]
        notes = [f"{word} {words.count(word)}" for word in ("dropouts", "spikes", "jump") if word in words]
        stuck = sum(bool(((stuck_m >= one.from_m) & (stuck_m < one.to_m)).any()) for one in inside)
        notes += [f"stuck {stuck}"] if stuck else []
        if (rounding := rounded.mpd_mm - depth.mpd_mm) > NOTABLE * depth.mpd_mm:
            notes.append("coarse")
            told.append(
                PROFILE_STEPS.finds(
                    "",
                    f"its heights lie on steps of {1e3 * sound.step_m:.3g} mm, and rounding alone makes its mean "
                    f"profile depth too high by some {rounding:.2f} mm from {first:.5g} m to {last:.5g} m.",
                )
            )
        notes += ["flat"] if depth.mpd_mm < FLATTEST_MM else []
        rows.append((first, last, depth.mpd_mm, depth.stdev_mm, rms_texture_mm(inside), depth.valid, depth.segments,
                     ", ".join(notes)))  # fmt: skip
    names = ("from_m", "to_m", "mpd_mm", "stdev_mm", "rms_mm", "valid_segments", "segments", "note")
    return ProfileTable(dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)), told)


def _sound_ride(x_m: npt.ArrayLike, height_m: npt.ArrayLike) -> tuple[Ride, list[SoundHeights]]:
    """Return the golden car's ride on profiles without faults, and their heights without samples that are not road."""
    x = stations_of(x_m)
    heights = [sound_heights(x, row) for row in heights_of(height_m, x.size)]
    on = ride(x, np.stack([one.height_m for one in heights]))
    for number, fault in enumerate(on.faults, 1):
        raise_fault(fault and (f"profile {number}: {fault}" if len(on.faults) > 1 else fault))
    return on, heights


def _rounding(x: Float64, sound: SoundHeights, parts: Segments, found: Float64) -> Float64:
    """Return the part of the IRI of segments (m/km) that is due to rounding."""
    if sound.step_m < FINEST_STEP_M:
        return np.zeros_like(found)
    return too_high_by(found, iri_of(ride(x, sound.rounded_again()), parts).iri_m_per_km)


def _left_out(x: Float64, sound: Sequence[SoundHeights], parts: Segments, k: int) -> list[str]:
    """Return words for the samples of a segment that were left out."""
    inside = (x >= parts.from_m[k]) & (x <= parts.to_m[k])
    told = {"stuck": [one.stuck for one in sound], "spikes": [one.spike for one in sound]}
    return [word for word, masks in told.items() if any((mask & inside).any() for mask in masks)]


def _whose(names: Sequence[str]) -> list[str]:
    return [f"profile {name}" for name in names] if len(names) > 1 else [""]


def _findings(x: Float64, sound: Sequence[SoundHeights], names: Sequence[str]) -> list[Finding]:
    of_each = (one.findings(x, whose) for one, whose in zip(sound, _whose(names), strict=True))
    return [finding for own in of_each for finding in own]


def _joined(on: Ride, parts: Segments, segment_m: float | None, found: Float64) -> list[str]:
    """Join the notes of all profiles, each word once."""
    of_all = on.notes(parts, segment_m)
    flat = np.atleast_1d((found < FLATTEST_M_PER_KM).any(axis=0))
    wild = np.atleast_1d((found > ROUGHEST_M_PER_KM).any(axis=0))
    joined = []
    for k in range(parts.from_m.size):
        words = [word for word in NOTES if any(word in notes[k] for notes in of_all)]
        joined.append(", ".join(words + ["flat"] * bool(flat[k]) + ["wild"] * bool(wild[k])))
    return joined


class MeanProfileDepth(NamedTuple):
    """MPD of a stretch."""

    mpd_mm: float
    """Mean depth of its valid segments (mm); NaN where fewer than half are valid."""
    stdev_mm: float
    """Standard deviation of the depths (mm, n − 1); NaN of fewer than two."""
    valid: int
    """Number of valid segments."""
    segments: int
    """Number of segments that begin in the stretch."""


def segment_depth_mm(height_mm: Float64) -> float:
    """Return the depth (mm) of a segment from its heights (n,): mean of both halves' peaks above the mean of all."""
    middle = height_mm.size // 2
    return float(0.5 * (height_mm[:middle].max() + height_mm[middle:].max()) - height_mm.mean())


def mean_profile_depth(segments: Sequence[TextureSegment]) -> MeanProfileDepth:
    """Return the MPD of segments taken together."""
    depths = np.array([segment_depth_mm(one.height_mm) for one in segments if not one.note])
    enough = depths.size > 0 and 2 * depths.size >= len(segments)
    return MeanProfileDepth(
        float(depths.mean()) if enough else np.nan,
        float(depths.std(ddof=1)) if enough and depths.size > 1 else np.nan,
        depths.size,
        len(segments),
    )


def mean_profile_depths(segments: Sequence[TextureSegment], stretches: Segments) -> list[MeanProfileDepth]:
    """Return the MPD of each stretch, from the segments that begin in it."""
    begin = np.array([one.from_m for one in segments])
    found = []
    for first, last in zip(stretches.from_m, stretches.to_m, strict=True):
        # A segment of 100 mm that begins on a border, up to rounding, begins behind it.
        inside = np.flatnonzero((begin >= first - 1e-6) & (begin < last - 1e-6)).tolist()
        found.append(mean_profile_depth([segments[k] for k in inside]))
    return found


class Stretch(NamedTuple):
    """A stretch where a quantity stays above a limit."""

    from_m: float
    """Station of its first sample (m)."""
    to_m: float
    """Station of its last sample (m)."""
    peak_m: float
    """Station of the greatest value (m)."""
    peak: float
    """The greatest value, in the unit of the quantity."""


def stretches_above(x_m: Float64, values: Float64, limit: float) -> list[Stretch]:
    """Return stretches where values (n,) at stations (n,) are above a limit, in order; NaN is not above it."""
    found = []
    for first, behind in runs_of(values > limit).tolist():
        peak = first + int(np.argmax(values[first:behind]))
        found.append(Stretch(float(x_m[first]), float(x_m[behind - 1]), float(x_m[peak]), float(values[peak])))
    return found
