"""Interior orientation of a camera from pictures of a chessboard.

Corners are found (Duda and Frese 2018, `findChessboardCornersSB`) and refined to a fraction of a pixel; focal lengths,
principal point and distortion are adjusted together with the board's pose in each picture (Zhang 2000,
`calibrateCameraExtended`), with their σ. Pictures that do not suffice are rejected with a reason: too few of them, too
similar, boards in the middle only, boards never tilted.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from roadscan.compute.array_types import Float64
from roadscan.core.errors import ConfigError
from roadscan.core.extras import cv2
from roadscan.core.rig import Interior
from roadscan.core.strict import Strict

Grey = npt.NDArray[np.uint8]

_PARAMETERS: Final = 9
"""fx, fy, cx, cy, k1, k2, p1, p2, k3."""
_COVER: Final = (6, 4)
"""Columns and rows of the cells by which coverage is counted."""
_WINDOW: Final = 0.3
"""Half the window that a corner is refined in, as a share of the least distance between corners."""
_LEAP_PX: Final = 1.0  # a corner that refinement moves farther (pixels) was found on something else
_SIGNIFICANT: Final = 2.0  # a distortion coefficient counts from twice its σ on
_ROUNDS: Final = 4  # rounds of leaving out outliers: later ones change nothing
_MOST_STEPS: Final = 200  # most steps of the solver
_SETTLED: Final = 1e-12  # relative change at which the solver ends


class Board(Strict):
    """A chessboard."""

    columns: int = Field(ge=3, le=100)
    """Inner corners along its longer side: one less than squares."""
    rows: int = Field(ge=3, le=100)
    """Inner corners along its shorter side."""
    square_m: float = Field(gt=0.0, le=1.0)
    """Edge of a square (m)."""

    @property
    def corners_m(self) -> npt.NDArray[np.float32]:
        """Inner corners (n, 3) on the board, row by row."""
        row, column = np.mgrid[: self.rows, : self.columns]
        flat = np.stack([column.ravel(), row.ravel(), np.zeros(row.size)], axis=-1)
        return (flat * self.square_m).astype(np.float32)


class InteriorOptions(Strict):
    """When pictures are good enough, and what is estimated from them."""

    least_pictures: int = Field(default=6, ge=3)
    """Pictures of different views that are needed."""
    least_shift: float = Field(default=0.02, ge=0.0, lt=1.0)
    """A view is another one where the board's corners lie, on the mean, at least this share of the picture's diagonal
    away from those of every other."""
    least_coverage: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of the picture's 6 × 4 cells in which corners have to lie: distortion is not known elsewhere."""
    focal_sigma_max: float = Field(default=0.01, gt=0.0)
    """Largest accepted 1 σ of the focal length, as a share of it: larger where the board is never tilted."""
    least_tilt_deg: float = Field(default=15.0, ge=0.0, lt=80.0)
    """At least a third of the boards are tilted by this much against the picture's plane (degrees): from flat views
    alone distance and focal length cannot be distinguished."""
    outlier: float = Field(default=3.0, gt=1.0)
    """Pictures with an RMS of more than this many times the usual one are left out."""
    radial: Literal[1, 2, 3] | None = None
    """Number of radial terms that are estimated; if omitted, k3 only if it differs significantly from 0."""


@dataclass(frozen=True)
class UsedPicture:
    """A picture that the orientation is estimated from."""

    name: str
    rms_px: float
    tilt_deg: float
    """Angle between the board's normal and the optical axis."""
    distance_m: float
    """From the camera to the board's middle."""
    residual_px: Float64
    """(n, 2) observed − computed, of each corner."""


@dataclass(frozen=True)
class RejectedPicture:
    """A picture that was left out."""

    name: str
    reason: str


@dataclass(frozen=True)
class InteriorReport:
    """An interior orientation and the pictures that it is estimated from."""

    interior: Interior
    used: tuple[UsedPicture, ...]
    rejected: tuple[RejectedPicture, ...]
    coverage: float
    """Share of the picture's cells with corners in them."""
    reach: float
    """Distance of the farthest corner from the principal point, as a share of that of the picture's farthest point."""


@dataclass(frozen=True)
class _View:
    name: str
    corners_px: npt.NDArray[np.float32]
    """(n, 2)"""


@dataclass(frozen=True)
class _Fit:
    matrix: Float64
    distortion: Float64
    sigma: Float64
    """(9,)"""
    rms_px: float
    turns: Sequence[Float64]
    shifts: Sequence[Float64]
    view_rms_px: Float64


def find_corners(grey: Grey, board: Board) -> npt.NDArray[np.float32] | None:
    """Inner corners (n, 2: u, v) of the board in a picture, row by row; None where it is not wholly seen."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not found or corners is None or len(corners) != board.columns * board.rows:
        return None
    return _refined(grey, np.asarray(corners, np.float32).reshape(-1, 2), board)


def _refined(grey: Grey, corners: npt.NDArray[np.float32], board: Board) -> npt.NDArray[np.float32]:
    """Refine corners by the gradients around them (Förstner and Gülch 1987); those that would move too far stay.

    Unrefined corners are biased by up to 0.08 px where the board is seen at a slant; refined ones are not.
    """
    grid = corners.reshape(board.rows, board.columns, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    half = int(np.clip(_WINDOW * min(steps), 2, 15))
    criteria = (int(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS), 100, 1e-4)
    moved = cv2.cornerSubPix(grey, corners.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria).reshape(-1, 2)
    leapt = np.linalg.norm(moved - corners, axis=1) > _LEAP_PX
    return np.where(leapt[:, None], corners, moved).astype(np.float32)


def interior_from_pictures(
    pictures: Iterable[tuple[str, Grey | None]],
    board: Board,
    options: InteriorOptions | None = None,
    date: dt.date | None = None,
) -> InteriorReport:
    """Estimate the interior orientation from pictures of a chessboard.

    Parameters
    ----------
    pictures : names and grey values (height, width); None where a picture could not be read.
    board : the chessboard.
    options : limits.
    date : day of the calibration, for the result.

    Raises
    ------
    ConfigError
        where the pictures do not determine the orientation, with what to photograph.
    """
    options = options or InteriorOptions()
    views, size, rejected = _views(pictures, board, options)
    _check_count(views, rejected, board, options)
    fit = _fitted(views, board, size, options)
    for _ in range(_ROUNDS):
        limit = options.outlier * float(np.median(fit.view_rms_px))
        bad = np.flatnonzero(fit.view_rms_px > limit)
        if bad.size == 0:
            break
        for k in bad:
            reason = f"RMS {fit.view_rms_px[k]:.2f} px, and {limit:.2f} px is {options.outlier:g} times the usual"
            rejected.append(RejectedPicture(views[k].name, reason))
        views = [view for k, view in enumerate(views) if k not in set(bad.tolist())]
        _check_count(views, rejected, board, options)
        fit = _fitted(views, board, size, options)
    coverage, reach = _coverage(views, size, fit)
    used = _used(views, board, fit)
    _check_fit(fit, coverage, np.array([picture.tilt_deg for picture in used]), options)
    return InteriorReport(_interior(fit, size, len(views), date), used, tuple(rejected), coverage, reach)


def _views(
    pictures: Iterable[tuple[str, Grey | None]], board: Board, options: InteriorOptions
) -> tuple[list[_View], tuple[int, int], list[RejectedPicture]]:
    """Return different views of the board, width and height of the pictures, and the pictures left out."""
    views: list[_View] = []
    rejected: list[RejectedPicture] = []
    size: tuple[int, int] | None = None
    for name, grey in pictures:
        reason, corners = "it cannot be read as a picture", None
        if grey is not None:
            pixels_of_file = (grey.shape[1], grey.shape[0])
            size = size or pixels_of_file
            if pixels_of_file != size:
                reason = f"it has {pixels_of_file[0]} × {pixels_of_file[1]} pixels, the first {size[0]} × {size[1]}"
            else:
                corners = find_corners(grey, board)
                reason = f"no whole board of {board.columns} × {board.rows} inner corners was found in it"
        if corners is not None and size is not None:
            twin = _twin(corners, views, options.least_shift * float(np.hypot(*size)))
            if twin is None:
                views.append(_View(name, corners))
                continue
            reason = f"the same view as {twin}"
        rejected.append(RejectedPicture(name, reason))
    if size is None:
        raise ConfigError("no picture could be read", expected="pictures of a chessboard, JPEG, PNG or TIFF")
    return views, size, rejected


def _twin(corners: npt.NDArray[np.float32], views: Sequence[_View], least_px: float) -> str | None:
    """Return the name of a picture that shows the board at the same place, whichever way its corners are counted."""
    for view in views:
        for order in (corners, corners[::-1]):
            if float(np.linalg.norm(order - view.corners_px, axis=1).mean()) < least_px:
                return view.name
    return None


def _check_count(
    views: Sequence[_View], rejected: Sequence[RejectedPicture], board: Board, options: InteriorOptions
) -> None:
    if len(views) >= options.least_pictures:
        return
    reasons = "; ".join(f"{r.name}: {r.reason}" for r in rejected[:5])
    more = f" (and {len(rejected) - 5} more)" if len(rejected) > 5 else ""
    raise ConfigError(
        f"{len(views)} of {len(views) + len(rejected)} pictures show a different view of the board each"
        + (f" ({reasons}{more})" if rejected else ""),
        expected=f"at least {options.least_pictures}",
        change=f"check that the board has {board.columns} × {board.rows} inner corners (one less than squares) and a "
        "white border, and take pictures from other sides, distances and tilts",
    )


def _fitted(views: Sequence[_View], board: Board, size: tuple[int, int], options: InteriorOptions) -> _Fit:
    """Fit with k3 if requested, or if it differs significantly from 0."""
    if options.radial is not None:
        return _fit(views, board, size, options.radial)
    full = _fit(views, board, size, 3)
    if abs(full.distortion[4]) > _SIGNIFICANT * full.sigma[8]:
        return full
    return _fit(views, board, size, 2)


def _fit(views: Sequence[_View], board: Board, size: tuple[int, int], radial: int) -> _Fit:
    flags = (0 if radial > 2 else int(cv2.CALIB_FIX_K3)) | (0 if radial > 1 else int(cv2.CALIB_FIX_K2))
    start = np.eye(3)
    try:
        rms, matrix, distortion, turns, shifts, sigma, _, view_rms = cv2.calibrateCameraExtended(
            [board.corners_m] * len(views),
            [view.corners_px.reshape(-1, 1, 2) for view in views],
            size,
            start,
            np.zeros(5),
            flags=flags,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _MOST_STEPS, _SETTLED),
        )
    except cv2.error as error:
        raise ConfigError(
            f"the pictures determine no camera ({str(error).strip().splitlines()[-1]})",
            expected="views of the board from several sides, tilted by 20 to 45 degrees",
        ) from error
    return _Fit(
        np.asarray(matrix, np.float64),
        np.asarray(distortion, np.float64).ravel()[:5],
        np.asarray(sigma, np.float64).ravel()[:_PARAMETERS],
        float(rms),
        [np.asarray(t, np.float64).ravel() for t in turns],
        [np.asarray(t, np.float64).ravel() for t in shifts],
        np.asarray(view_rms, np.float64).ravel(),
    )


def _coverage(views: Sequence[_View], size: tuple[int, int], fit: _Fit) -> tuple[float, float]:
    """Return the share of the picture's cells with corners, and the reach of the corners as a share of the farthest."""
    corners = np.concatenate([view.corners_px for view in views]).astype(np.float64)
    cells = np.clip((corners + 0.5) / size * _COVER, 0, np.array(_COVER) - 1).astype(np.int64)
    share = len(np.unique(cells, axis=0)) / (_COVER[0] * _COVER[1])
    middle = fit.matrix[:2, 2]
    frame = np.array([(u, v) for u in (-0.5, size[0] - 0.5) for v in (-0.5, size[1] - 0.5)])
    farthest = np.linalg.norm(frame - middle, axis=1).max()
    return share, float(np.linalg.norm(corners - middle, axis=1).max() / farthest)


def _check_fit(fit: _Fit, coverage: float, tilt_deg: Float64, options: InteriorOptions) -> None:
    if (tilt_deg >= options.least_tilt_deg).sum() < len(tilt_deg) / 3.0:
        raise ConfigError(
            f"{(tilt_deg >= options.least_tilt_deg).sum()} of {len(tilt_deg)} boards are tilted by "
            f"{options.least_tilt_deg:g} degrees or more",
            expected="a third of them, or more",
            change="take pictures with the board tilted by 20 to 45 degrees, to different sides",
        )
    if coverage < options.least_coverage:
        raise ConfigError(
            f"the board's corners lie in {coverage:.0%} of the picture's cells",
            expected=f"{options.least_coverage:.0%} or more: the distortion is not known where no corner was",
            change="take pictures with the board at the edges and in the corners of the picture",
        )
    focal = np.array([fit.matrix[0, 0], fit.matrix[1, 1]])
    if not np.isfinite(focal).all() or (focal <= 0.0).any() or (fit.sigma[:2] > options.focal_sigma_max * focal).any():
        raise ConfigError(
            f"the focal length of {focal[0]:.0f} px is known to {fit.sigma[0]:.0f} px (1 σ)",
            expected=f"{options.focal_sigma_max:.1%} of it or less",
            change="take pictures with the board tilted by 20 to 45 degrees, to different sides",
        )


def _interior(fit: _Fit, size: tuple[int, int], pictures: int, date: dt.date | None) -> Interior:
    focal_sigma, principal_sigma, distortion_sigma = fit.sigma[:2], fit.sigma[2:4], fit.sigma[4:]
    return Interior(
        width_px=size[0],
        height_px=size[1],
        focal_px=(float(fit.matrix[0, 0]), float(fit.matrix[1, 1])),
        principal_px=(float(fit.matrix[0, 2]), float(fit.matrix[1, 2])),
        distortion=_five(fit.distortion),
        sigma_focal_px=(float(focal_sigma[0]), float(focal_sigma[1])),
        sigma_principal_px=(float(principal_sigma[0]), float(principal_sigma[1])),
        sigma_distortion=_five(distortion_sigma),
        rms_px=fit.rms_px,
        pictures=pictures,
        date=date,
    )


def _five(values: Float64) -> tuple[float, float, float, float, float]:
    a, b, c, d, e = (float(v) for v in values)
    return a, b, c, d, e


def _used(views: Sequence[_View], board: Board, fit: _Fit) -> tuple[UsedPicture, ...]:
    found = []
    middle = board.corners_m.mean(axis=0).astype(np.float64)
    for view, turn, shift, rms in zip(views, fit.turns, fit.shifts, fit.view_rms_px.tolist(), strict=True):
        computed, _ = cv2.projectPoints(board.corners_m, turn, shift, fit.matrix, fit.distortion)
        rotation, _ = cv2.Rodrigues(turn)
        found.append(
            UsedPicture(
                view.name,
                rms,
                float(np.degrees(np.arccos(np.clip(abs(rotation[2, 2]), 0.0, 1.0)))),
                float(np.linalg.norm(rotation @ middle + shift)),
                view.corners_px.astype(np.float64) - computed.reshape(-1, 2),
            )
        )
    return tuple(found)
