"""Settings of the ties between passes: where they are sought, and what they have to pass."""

from __future__ import annotations

from pydantic import Field

from roadscan.core.strict import Strict


class PlaceSettings(Strict):
    """Where passes are tied to one another."""

    per_km: float = Field(default=200.0, gt=0.0, le=2000.0)
    """Places per kilometre of road and overlapping strip."""
    radius_m: float = Field(default=0.5, gt=0.0, le=20.0)
    """Half the edge of the patch of road that is compared (m)."""
    lidar_per_km: float = Field(default=50.0, gt=0.0, le=2000.0)
    """Places per kilometre for sensors that see ahead, whose planes are compared."""
    lidar_radius_m: float = Field(default=8.0, gt=0.0, le=100.0)
    """Half the edge of the square that their planes are taken from (m)."""
    seams_per_km: float = Field(default=50.0, gt=0.0, le=2000.0)
    """Places per kilometre where heads of one pass that overlap by a few centimetres are compared."""
    seam_radius_m: float = Field(default=2.0, gt=0.0, le=20.0)
    """Half the length of road that is compared at each of them (m): a narrow strip has to be long."""
    margin_m: float = Field(default=0.3, ge=0.0)
    """Readings are taken from so much farther ahead and behind: passes lie apart by what their poses are off (m)."""
    least_overlap_m: float = Field(default=0.2, gt=0.0)
    """Narrowest strip that two passes have to share (m)."""
    return_s: float = Field(default=30.0, gt=0.0)
    """A run that is back at a place after this time or more passes it anew (s)."""
    height_apart_m: float = Field(default=2.0, gt=0.0)
    """Tracks farther apart in height do not meet: one crosses above the other (m)."""
    gap_s: float = Field(default=2.0, gt=0.0)
    """Between positions of a trajectory farther apart in time there is no place (s)."""
    longest_s: float = Field(default=10.0, gt=0.0)
    """Readings of a place are taken for so long at most, where a vehicle stands there (s)."""


class AgainSettings(Strict):
    """When ties are observed again, and how passes that lie far apart are brought together first."""

    share: float = Field(default=0.05, gt=0.0, le=1.0)
    """A place is observed again where the solution moves its passes against one another by more than this share of the
    patch's edge: 5 cm of a patch of 1 m. What moved by less was matched where it lies."""
    rounds: int = Field(default=3, ge=0, le=10)
    """Times that ties are observed again, at most: one brings passes to centimetres, the next ones to the σ of the
    ties, and what moves after three does not settle. 0: never."""
    search_m: float = Field(default=1.0, gt=0.0, le=5.0)
    """How far apart (m), along, across and in height, two passes are sought with larger patches."""
    radius_m: float = Field(default=2.0, gt=0.0, le=20.0)
    """Half the edge of the larger patch (m)."""
    cell_m: float = Field(default=0.02, gt=0.0, le=1.0)
    """Edge of its cells (m): cracks are to be seen."""
    each_m: float = Field(default=100.0, gt=0.0)
    """Distance of larger patches along the road (m): errors of poses vary over minutes."""
    least: int = Field(default=20, ge=3)
    """Larger patches of two runs, at least, where they have so many places."""
    alike_m: float = Field(default=0.1, gt=0.0)
    """Larger patches count that agree with most of the others to this; passes lie no farther above one another (m)."""


class TieSettings(Strict):
    """How two passes are compared at a place, and what a tie has to pass to count."""

    return_s: float = Field(default=30.0, gt=0.0)
    """Readings of one run nearer in time than this are no other pass: what ties them says how well heads agree, and is
    not used for the poses (s)."""
    cell_m: float = Field(default=0.025, gt=0.0)
    """Edge of the cells that heights are compared in (m)."""
    least_readings: int = Field(default=3, ge=1)
    """A cell holds a height from so many readings on."""
    least_cells: int = Field(default=100, ge=16)
    """Two patches are compared where both saw so many cells."""
    least_share: float = Field(default=0.3, gt=0.0, le=1.0)
    """Of the cells that both saw, this share has to agree."""
    most_apart_m: float = Field(default=0.3, gt=0.0)
    """Surfaces farther apart in height than this are not the same one (m)."""
    most_scatter_m: float = Field(default=0.01, gt=0.0)
    """Height differences of the cells of a tie scatter no more than this (m, robust 1 σ)."""
    steepest: float = Field(default=0.2, gt=0.0)
    """A patch that is steeper than this is no road (m/m)."""
    misplaced_m: float = Field(default=0.03, ge=0.0)
    """1 σ of how far two passes may lie apart horizontally (m): with the unevenness of the patch it adds to the σ of a
    height tie."""
    sigma_floor_m: float = Field(default=2e-5, gt=0.0)
    """No tie is better than this (m, 1 σ): rounding, what a pose changes within a patch."""
    outlying: float = Field(default=4.0, gt=1.0)
    """Cells that differ from the rest by more than so many σ are left out."""
    shift_cell_m: float = Field(default=0.01, gt=0.0)
    """Edge of the cells of the pictures and reliefs that horizontal shifts are found in (m)."""
    search_m: float = Field(default=0.15, gt=0.0)
    """Shifts are sought up to so far along and across (m)."""
    least_correlation: float = Field(default=0.3, gt=0.0, lt=1.0)
    """Correlation of two pictures or reliefs from which on they may show the same place."""
    rival_share: float = Field(default=0.75, gt=0.0, lt=1.0)
    """A shift is ambiguous where another one correlates with this share of the best correlation."""
    coherence: float = Field(default=0.4, gt=0.0, lt=1.0)
    """A direction counts where this share of the slopes' energy is common to both; the rest is noise."""
    most_shift_sigma_m: float = Field(default=0.01, gt=0.0)
    """A direction that is known worse than this makes no tie (m, 1 σ)."""
    shift_floor_m: float = Field(default=2e-4, gt=0.0)
    """No shift is known better than this (m, 1 σ): spacing of readings, what a pose changes within a patch."""
    window_s: float = Field(default=0.2, gt=0.0)
    """Returns of a lidar that are taken together as seen from one pose (s)."""
    one_return_in: int = Field(default=3, ge=1, le=100)
    """Of so many returns of a lidar that follow one another one is looked at. A number that shares no divisor with that
    of the lasers takes from all of them."""
    plane_cell_m: float = Field(default=1.0, gt=0.0)
    """Edge of the cubes in which planes are sought (m)."""
    least_returns: int = Field(default=6, ge=3)
    """A window sees a plane where it has so many returns on it."""
    thickest_m: float = Field(default=0.05, gt=0.0)
    """Returns of a plane scatter about it no more than this (m, 1 σ)."""
    uneven_m: float = Field(default=0.003, ge=0.0)
    """1 σ of how far the means of returns on different spots of a plane differ because it is uneven (m)."""
    most_planes: int = Field(default=30, ge=1)
    """Planes of a place that make ties: those with the most returns, a sixth of them for each direction (along the
    road, across and up) where there are so many."""
