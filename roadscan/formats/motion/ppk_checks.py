"""Witnesses of a post-processed drive: the base's place, common time, fixed epochs, one direction against the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.crs import crs_from_text, world_frame_of, world_from_geodetic
from roadscan.core.errors import ConfigError, FormatError, Missing
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.core.settings.navigation import PpkBase, PpkSettings
from roadscan.core.witness import Finding, Witness
from roadscan.formats.motion.rtklib_programs import RinexHeader
from roadscan.ingest.reading.gnss import ned_from_ecef

BASE_REFUSED_M: Final = 20.0
"""Farther than this from its code solution, a base stands elsewhere or its position is of another datum or kind of
height: the median of code solutions is wrong by some metres, and by ten in height under a strong ionosphere."""
BASE_DOUBTED_M: Final = 6.0
"""Horizontal distance that is worth a look: three times the usual error of a median of code solutions (m)."""
_UNCOVERED_SHARE: Final = 0.01
"""Share of the rover's epochs without an observation of the base, above which it is reported."""
FIXED_SHARE: Final = 0.5
"""Share of fixed epochs below which a solution is reported as weak: on open roads it is above 0.9."""
_DISAGREE_SIGMAS: Final = 4.0
"""Differences of both directions beyond this many of their σ have a chance of 6e-5 each."""
_DISAGREE_SHARE: Final = 0.01
"""Share of such epochs above which it is reported: single ones are at the ends of outages."""
_ELLIPSOID: Final = (6_378_137.0, 298.257223563)
"""Semi-major axis (m) and inverse flattening that RTKLIB has for all datums."""
_FLATTENING_OFF: Final = 1e-4
"""How far the inverse flattening of another may differ: that of GRS 80 does by 1.5e-6, 0.1 mm of height."""
_HEIGHT_OFF_M: Final = 0.0005  # antenna heights are stated to the millimetre

BASE_PLACE: Final = Witness(
    name="ppk_base_place",
    input="raw GNSS observations",
    fault="The base's position is that of another place, of another datum, or has another kind of height.",
    asks="the median of positions that the base's own code observations give",
    does=f"a log whose base is off by more than {BASE_REFUSED_M:g} m is refused with both positions; one that is off "
    f"by more than {BASE_DOUBTED_M:g} m in the plane is used and named",
    told=("error", "findings"),
)
COMMON_TIME: Final = Witness(
    name="ppk_common_time",
    input="raw GNSS observations",
    fault="The base did not observe during the drive, or not all the time.",
    asks="the epochs of rover and base",
    does="without a common epoch the log is refused with both spans; else the uncovered share is named",
    told=("error", "rejects", "findings"),
)
FIXED: Final = Witness(
    name="ppk_fixed",
    input="raw GNSS observations",
    fault="Few epochs have fixed ambiguities: the positions are good to decimetres only.",
    asks="RTKLIB's quality of each epoch",
    does="all positions are used with their stated σ; the share is named",
    told=("findings",),
)
DIRECTIONS: Final = Witness(
    name="ppk_directions",
    input="raw GNSS observations",
    fault="Ambiguities were fixed to wrong numbers: the positions are off by decimetres, and their σ does not say so.",
    asks="the solutions forward and backward in time, which find their ambiguities independently",
    does="a combined solution is float where both are fixed and contradict each other; the share is named",
    told=("findings",),
)
ANTENNA_HEIGHT: Final = Witness(
    name="ppk_antenna_height",
    input="raw GNSS observations",
    fault="The height of an antenna above its mark is missing or another than its file says.",
    asks="the header of the RINEX file, against the survey file",
    does="a log whose heights are not stated is refused, with the file's named; a stated height that differs from "
    "the file's is used, and both are named",
    told=("error", "findings"),
)


@dataclass(frozen=True)
class Track:
    """Positions of one solution."""

    epochs_gps_ns: Int64
    world_m: Float64
    """(n, 3)"""
    sigma_ned_m: Float64
    """(n, 3)"""
    is_fixed: npt.NDArray[np.bool_]


def base_position_m(base: PpkBase, file: Path) -> Float64:
    """Return the geocentric position (3,) of the base's mark in its datum.

    Raises
    ------
    ConfigError
        where the CRS is of another kind than the position, knows other heights than ellipsoidal ones or an ellipsoid
        that RTKLIB does not, or moves with time and no epoch is stated.
    """
    crs = crs_from_text(base.crs, "base.crs")
    fits = crs.is_geocentric if base.is_geocentric else crs.is_geographic and len(crs.axis_info) == 3  # with heights
    if not fits:
        kind, example = ("geocentric", "4978") if base.is_geocentric else ("geographic with three axes", "4979")
        raise ConfigError(
            f"the base's crs '{base.crs}' ({crs.name}) is not {kind}, as its position is",
            expected=f'such a CRS, as base.crs = "EPSG:{example}"; heights of the base are ellipsoidal',
            file=file,
        )
    shape = crs.ellipsoid
    if shape is None or not np.allclose(
        (shape.semi_major_metre, shape.inverse_flattening), _ELLIPSOID, rtol=0, atol=_FLATTENING_OFF
    ):
        raise ConfigError(
            f"the ellipsoid of '{base.crs}' is not known to RTKLIB", expected="GRS 80 or WGS 84", file=file
        )
    if base.epoch is None and _moves(crs.to_json_dict()):
        raise ConfigError(
            f"coordinates in '{base.crs}' ({crs.name}) move with time, and the epoch of the base's is not stated",
            expected="base.epoch, a decimal year such as 2020.5",
            file=file,
        )
    if base.is_geocentric:
        return np.array(base.position)
    latitude, longitude, height = base.position
    return world_from_geodetic(world_frame_of(base.crs), np.array([[longitude, latitude, height]])).reshape(3)


def _moves(crs: dict[str, Any]) -> bool:
    """Whether positions fixed to the ground have other coordinates each year."""
    dynamic = "Dynamic" in crs.get("datum", {}).get("type", "")
    return dynamic or "World Geodetic System" in crs.get("datum_ensemble", {}).get("name", "")


def antenna_findings(settings: PpkSettings, rover: RinexHeader, base: RinexHeader, file: Path) -> Iterator[Finding]:
    """Yield antenna heights that differ from those of the files.

    Raises
    ------
    ConfigError
        where a height has to be stated: the base's always, the rover's where its file says one.
    """
    stated = None if settings.base is None else settings.base.antenna_height_m
    if stated is None:
        raise ConfigError(
            f"the height of the base's antenna above its mark is not stated{_said(base)}",
            expected="base.antenna_height_m (m); 0 where the base's position is that of its antenna",
            file=file,
        )
    if settings.antenna_height_m is None and rover.antenna_height_m:
        raise ConfigError(
            f"the height of the rover's antenna is not stated{_said(rover)}",
            expected="antenna_height_m (m): 0 for the position of the antenna itself, as a rig's lever arm needs it",
            file=file,
            missing=Missing("options.antenna_height_m", 0.0),
        )
    for name, used, header in (("base", stated, base), ("rover", settings.antenna_height_m, rover)):
        said = header.antenna_height_m
        if used is None or said is None or abs(used - said) <= _HEIGHT_OFF_M:
            continue
        unsure = "" if said else " Many programs write zero where they do not know it: look at the record of the site."
        yield ANTENNA_HEIGHT.finds(
            "", f"The height of the {name}'s antenna is stated as {used:.4f} m, its file says {said:.4f} m. "
            f"The stated one is used.{unsure}",
        )  # fmt: skip


def _said(header: RinexHeader) -> str:
    return "" if header.antenna_height_m is None else f" (its file says {header.antenna_height_m:.4f} m)"


def common_time(rover: Int64, base: Int64, max_age_s: float, file: Path) -> tuple[int, list[Finding]]:
    """Return how many of the rover's epochs (n,) have one of the base (m,) near enough, and what is doubtful of that.

    Raises
    ------
    FormatError
        where none has.
    """
    base = np.sort(base)
    after = np.clip(np.searchsorted(base, rover), 1, max(base.size - 1, 1))
    near = np.minimum(np.abs(rover - base[after - 1]), np.abs(base[np.minimum(after, base.size - 1)] - rover))
    covered = int((near <= max_age_s * NS_PER_S).sum())
    if covered == 0:
        raise FormatError(
            f"rover and base have no common time: the rover observed {_span(rover)}, the base {_span(base)}",
            expected="observations of the base during the drive",
            file=file,
        )
    missing = rover.size - covered
    if missing <= _UNCOVERED_SHARE * rover.size:
        return covered, []
    text = (
        f"The base has no observation within {max_age_s:g} s of {missing:,} of the rover's {rover.size:,} epochs: the "
        f"rover observed {_span(rover)}, the base {_span(base)}. These epochs have no position."
    )
    return covered, [COMMON_TIME.finds("", text)]


def _span(epochs: Int64) -> str:
    return f"{iso_from_gps_ns(int(epochs.min()))} to {iso_from_gps_ns(int(epochs.max()))}"


def base_place(
    own: Track, mark_m: Float64, base: PpkBase, header: RinexHeader, file: Path
) -> tuple[float, list[Finding]]:
    """Return the distance (m) of the base from the median of its code solutions, and whether it is doubtful.

    Raises
    ------
    FormatError
        where it is too far for an error of code.
    """
    world = world_frame_of(base.crs)
    turn = ned_from_ecef(world, mark_m[:, None])[0]
    off = turn @ (np.median(own.world_m, axis=0) - mark_m) + [0.0, 0.0, base.antenna_height_m or 0.0]
    far, plane = float(np.linalg.norm(off)), float(np.hypot(off[0], off[1]))
    stated, found = (", ".join(f"{x:.3f}" for x in one) for one in (mark_m, np.median(own.world_m, axis=0)))
    text = (
        f"the base is stated at X, Y, Z = {stated} m ({base.crs}), its own code observations say {found} m: "
        f"{off[0]:+.1f} m north, {off[1]:+.1f} m east, {-off[2]:+.1f} m up"
    )
    if far > BASE_REFUSED_M:
        near = header.approximate_m
        hint = (
            "" if near is None else f"; the approximate position in its file is {', '.join(f'{x:.3f}' for x in near)}"
        )
        raise FormatError(
            text + hint,
            expected=f"less than {BASE_REFUSED_M:g} m",
            change="state the position of this base, in its datum, with its ellipsoidal height",
            file=file,
        )
    doubt = [BASE_PLACE.finds("", f"{text[0].upper()}{text[1:]}. The stated position is used.")]
    return far, doubt if plane > BASE_DOUBTED_M else []


def fixed_share(fixed: int, solved: int) -> list[Finding]:
    """Return whether too few epochs are fixed."""
    if fixed >= FIXED_SHARE * solved:
        return []
    return [FIXED.finds("", f"Of {solved:,} epochs with a position, {fixed:,} have fixed ambiguities. All are used.")]


@dataclass(frozen=True)
class Separation:
    """Backward less forward positions at their common epochs."""

    epochs_gps_ns: Int64
    ned_m: Float64
    """(n, 3)"""
    both_fixed: npt.NDArray[np.bool_]
    beyond: npt.NDArray[np.bool_]
    """Both are fixed, and the difference is beyond its σ."""

    @classmethod
    def of(cls, forward: Track, backward: Track, world: str) -> Separation:
        """Compare two directions."""
        epochs, one, other = np.intersect1d(
            forward.epochs_gps_ns, backward.epochs_gps_ns, assume_unique=False, return_indices=True
        )
        difference = backward.world_m[other] - forward.world_m[one]
        ned = np.einsum("nij,nj->ni", ned_from_ecef(world, forward.world_m[one].T), difference)
        both = forward.is_fixed[one] & backward.is_fixed[other]
        sigma = np.hypot(forward.sigma_ned_m[one], backward.sigma_ned_m[other])
        return cls(epochs, ned, both, both & (np.abs(ned) > _DISAGREE_SIGMAS * sigma).any(axis=1))

    def findings(self) -> list[Finding]:
        """Return whether both directions contradict each other."""
        count, beyond = int(self.both_fixed.sum()), int(self.beyond.sum())
        if beyond <= _DISAGREE_SHARE * count:
            return []
        most = np.abs(self.ned_m[self.beyond]).max(axis=0)
        text = (
            f"Forward and backward solutions are fixed at {count:,} common epochs and differ at {beyond:,} of them by "
            f"more than {_DISAGREE_SIGMAS:g} σ: by up to {most[0]:.3f} m north, {most[1]:.3f} m east, {most[2]:.3f} m "
            "down. Ambiguities are fixed to wrong numbers there, in one direction at least."
        )
        return [DIRECTIONS.finds("", text)]

    def figures(self, bins: int) -> dict[str, Any]:
        """Return the differences as JSON: 95th percentiles where both are fixed, and the largest of each of `bins`."""
        if self.epochs_gps_ns.size == 0:
            return {"both_fixed": 0, "beyond_sigma": 0}
        plane, height = np.hypot(self.ned_m[:, 0], self.ned_m[:, 1]), np.abs(self.ned_m[:, 2])
        first, last = (int(self.epochs_gps_ns[k]) for k in (0, -1))
        edges = np.linspace(first, last + 1, min(bins, self.epochs_gps_ns.size) + 1)
        starts = np.unique(np.searchsorted(self.epochs_gps_ns, edges[:-1]))
        starts = starts[starts < plane.size]
        return {
            "both_fixed": int(self.both_fixed.sum()),
            "beyond_sigma": int(self.beyond.sum()),
            "horizontal_p95_m": _percentile(plane[self.both_fixed]),
            "vertical_p95_m": _percentile(height[self.both_fixed]),
            "epochs_gps_ns": self.epochs_gps_ns[starts].tolist(),
            "horizontal_m": np.round(np.maximum.reduceat(plane, starts), 4).tolist(),
            "vertical_m": np.round(np.maximum.reduceat(height, starts), 4).tolist(),
        }


def _percentile(values: Float64) -> float | None:
    return round(float(np.percentile(values, 95)), 4) if values.size else None


def joined(tracks: Sequence[Track]) -> Track:
    """Return pieces of a solution as one."""
    return Track(
        np.concatenate([t.epochs_gps_ns for t in tracks]), np.concatenate([t.world_m for t in tracks]),
        np.concatenate([t.sigma_ned_m for t in tracks]), np.concatenate([t.is_fixed for t in tracks]),
    )  # fmt: skip
