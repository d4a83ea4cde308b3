"""Plane patches of a point cloud, with the uncertainty of each plane, to which readings are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from roadscan.compute.array_types import Float64, Int64
from roadscan.core.errors import ConfigError

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


_FLAT: Final = 0.2
"""A cell may contain a plane if its thickness is below this share of its second extent."""
_WIDE: Final = 0.15
"""Least spread (1 σ, along the shorter axis) of a patch's points, as a share of the cell."""
_THICK: Final = 2.0
"""Patches thicker than this many times the cloud's usual thickness are no planes but leaves, edges, poles."""
_TRIM: Final = 3.0  # Points farther from the plane than this many σ are left out of the second fit.
_LEAST_THICKNESS_M: Final = 1e-4  # Least thickness of a plane that is assumed.
_KEY_BITS: Final = 21  # Bits of a cell's key for each of its three indices.
_AROUND: Final = 8.0
"""Patches within this many cells may lie on one even surface."""
_SAME: Final = 3.0  # Normals within this many σ of their difference may belong to one even surface …
_BENT_RAD: Final = 0.005  # … with this much added for the curvature of the surface.
_FEW: Final = 8  # With fewer such neighbours the mean of a normal is not used.


@dataclass(frozen=True)
class Surfels:
    """Plane patches, one for each cell of a cubic grid, in the axes of their cloud."""

    cell_m: float
    centre_m: Float64
    """(m, 3) mean of the patch's points."""
    normal: Float64
    """(m, 3) unit vectors of either sign."""
    points: Int64
    """(m,) number of its points."""
    thickness_m: Float64
    """(m,) RMS distance of its points from the plane."""
    slopes: Float64
    """(m, 3, 3) covariance of the plane's tilt: an offset d from the centre adds the variance dᵀ · slopes · d (1)."""
    wobble: Float64
    """(m, 3, 3) covariance of the normal as the direction of an even surface."""

    @classmethod
    def of(cls, cloud_m: Float64, cell_m: float, least_points: int = 8) -> Self:
        """Fit planes to the points (n, 3) of each cell, trimmed once; cells without a plane are left out.

        Raises
        ------
        ConfigError
            where no cell holds a plane.
        """
        cell = _cells(cloud_m, cell_m)
        count, mean, values, vectors = plane_moments(cloud_m, cell)
        away = np.abs(np.einsum("ij,ij->i", cloud_m - mean[cell], vectors[cell, :, 0]))
        near = away <= _TRIM * np.sqrt(np.maximum(values[cell, 0], _LEAST_THICKNESS_M**2))
        count, mean, values, vectors = plane_moments(cloud_m[near], cell[near], count.size)
        values = np.maximum(values, _LEAST_THICKNESS_M**2)
        flat = (count >= least_points) & (values[:, 0] < _FLAT**2 * values[:, 1])
        flat &= values[:, 1] >= (_WIDE * cell_m) ** 2
        if flat.any():
            flat &= values[:, 0] <= _THICK**2 * np.median(values[flat, 0])
        if not flat.any():
            raise ConfigError(
                f"the reference scan of {len(cloud_m):,} points holds no plane of {cell_m:g} m",
                expected=f"at least {least_points} points in each cell of that size on walls and ground",
                change="enlarge cell_m, or take a denser scan",
            )
        # A least-squares plane through k points: the σ of its tilt along an axis of spread s is thickness / (s √k).
        variance = values[flat, :1] / (np.maximum(count[flat, None] - 3, 1) * values[flat, 1:])
        axes = vectors[flat][:, :, 1:]
        slopes = np.einsum("mia,ma,mja->mij", axes, variance, axes)
        rough = cls(cell_m, mean[flat], vectors[flat, :, 0], count[flat], np.sqrt(values[flat, 0]), slopes, slopes)
        return rough._steadied()

    def __len__(self) -> int:
        return len(self.centre_m)

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.centre_m)

    def nearest(self, place_m: Float64, gate_m: Float64) -> tuple[Int64, Float64]:
        """Return the patch (n,) at each place (n, 3), −1 for none, and the place's distance (n,) from its plane.

        gate_m : (n,) how far a place may lie from its plane; beside the patch it may lie three quarters of a cell.
        """
        beside = 0.75 * self.cell_m
        reach = float(np.hypot(gate_m.max(initial=0.0), beside))
        found, index = self._tree.query(place_m, distance_upper_bound=reach)
        patch = np.where(np.isfinite(found), index, 0).astype(np.int64)
        offset = place_m - self.centre_m[patch]
        distance = np.einsum("ij,ij->i", offset, self.normal[patch])
        lateral = np.einsum("ij,ij->i", offset, offset) - distance**2
        fits = np.isfinite(found) & (np.abs(distance) <= gate_m) & (lateral <= beside**2)
        return np.where(fits, patch, -1), distance

    def variance_m2(self, patch: Int64, place_m: Float64) -> Float64:
        """Return the variance (n,) of the planes of patches (n,) at places (n, 3)."""
        offset = place_m - self.centre_m[patch]
        tilt = np.einsum("ni,nij,nj->n", offset, self.slopes[patch], offset)
        return np.asarray(self.thickness_m[patch] ** 2 / self.points[patch] + tilt)

    def _steadied(self) -> Self:
        """Return patches with normals averaged over neighbours that could lie on one even surface.

        Ground whose patches are tilted a little, by noise or by roughness, would seem to determine horizontal shifts,
        which each tilt resists. That is deceptive, because the tilt of the next patch differs. The scatter of the
        normals counts as the plane's uncertainty, and that of their mean as the normal's.
        """
        from scipy.sparse import csr_matrix

        variance = np.trace(self.slopes, axis1=1, axis2=2) / 2.0
        pairs, sign = self._alike(variance)
        ones = np.arange(len(self))
        first, second = (np.concatenate([pairs[:, a], pairs[:, b], ones]) for a, b in ((0, 1), (1, 0)))
        signs = np.concatenate([sign, sign, np.ones(len(self))])
        weight = csr_matrix((signs / variance[second], (first, second)), shape=(len(self), len(self)))
        total = np.asarray(abs(weight).sum(axis=1)).ravel()
        mean = (weight @ self.normal) / total[:, None]
        length = np.linalg.norm(mean, axis=1)
        neighbours = np.bincount(first, minlength=len(self))
        # |n_j − mean|² summed with weights, from the sums of squares: normals are unit vectors.
        scatter = np.maximum((1.0 - length**2) / 2.0, 1.0 / total)
        alone = neighbours < _FEW
        of_mean = np.where(alone, variance, scatter / neighbours)
        tilt = np.where(alone, variance, np.maximum(scatter - neighbours / total, 0.0) + of_mean)
        across = self.slopes / variance[:, None, None]
        return replace(
            self,
            normal=np.where(alone[:, None], self.normal, mean / length[:, None]),
            slopes=across * tilt[:, None, None],
            wobble=across * of_mean[:, None, None],
        )

    def _alike(self, variance: Float64) -> tuple[Int64, Float64]:
        """Pairs (p, 2) of nearby patches that could lie on one even surface, and the sign between their normals."""
        pairs = self._tree.query_pairs(_AROUND * self.cell_m, output_type="ndarray")
        i, j = pairs.T
        cosine = np.einsum("ij,ij->i", self.normal[i], self.normal[j])
        offset = self.centre_m[j] - self.centre_m[i]
        step = np.maximum(*(np.abs(np.einsum("ij,ij->i", offset, self.normal[k])) for k in (i, j)))
        tilt = _SAME * np.sqrt(variance[i] + variance[j]) + _BENT_RAD
        near = np.linalg.norm(offset, axis=1)
        same = (1.0 - np.abs(cosine) < tilt**2 / 2.0) & (step < tilt * near + self.thickness_m[i])
        return pairs[same].astype(np.int64), np.sign(cosine[same])


def _cells(cloud_m: Float64, cell_m: float) -> Int64:
    """Return the number (n,) of the cell of each point, counted from 0 without gaps."""
    whole = np.floor((cloud_m - cloud_m.min(axis=0)) / cell_m).astype(np.int64)
    if whole.max() >= 1 << _KEY_BITS:
        raise ConfigError(
            f"the reference scan extends over {np.ptp(cloud_m, axis=0).max():,.0f} m",
            expected=f"less than {(1 << _KEY_BITS) * cell_m:,.0f} m in cells of {cell_m:g} m",
            change="cut the scan to the vehicle's surroundings",
        )
    key = (whole[:, 0] << 2 * _KEY_BITS) | (whole[:, 1] << _KEY_BITS) | whole[:, 2]
    return np.asarray(np.unique(key, return_inverse=True)[1], np.int64)


def plane_moments(cloud_m: Float64, cell: Int64, cells: int | None = None) -> tuple[Int64, Float64, Float64, Float64]:
    """Return count (m,), mean (m, 3), ascending eigenvalues (m, 3) and eigenvectors (m, 3, 3; columns) of each cell."""
    size = int(cell.max()) + 1 if cells is None else cells
    count = np.bincount(cell, minlength=size)
    least = np.maximum(count, 1)
    mean = np.stack([np.bincount(cell, cloud_m[:, a], size) for a in range(3)], axis=-1) / least[:, None]
    centred = cloud_m - mean[cell]
    covariance = np.empty((size, 3, 3))
    for a in range(3):
        for b in range(a + 1):
            covariance[:, a, b] = np.bincount(cell, centred[:, a] * centred[:, b], size) / least
            covariance[:, b, a] = covariance[:, a, b]
    values, vectors = np.linalg.eigh(covariance)
    return count, mean, values, vectors
