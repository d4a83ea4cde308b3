"""Settings of the detection of cracks and potholes on a gridded surface."""

from __future__ import annotations

from pydantic import Field, model_validator

from roadscan.core.strict import Strict


class CrackDetection(Strict):
    """Where a surface has cracks (``crack_response.py``, ``cracks.py``)."""

    max_width_m: float = Field(default=0.04, gt=0.0, le=0.2)
    """Widest crack that is looked for (m): a valley whose flanks are farther apart is none."""
    lowered_m: float = Field(default=0.002, ge=0.0, le=0.05)
    """A crack goes on where it is in the lowest readings of cells alone, because it takes in less than half of each, if
    it leads to another that heights show. Each cell is lowered to its lowest reading for that, but by this at most (m).
    0: heights alone."""
    lowest_alone: bool = False
    """Cracks begin and end where lowest readings alone show them as well: of cracks of 3 mm more is found in cells of
    5 mm. But a single profile that lies lower than its neighbours is a crack then."""
    strong_sigmas: float = Field(default=6.0, gt=0.0)
    """A crack begins where a line of cells lies deeper than its flanks by this many σ of such lines nearby …"""
    weak_sigmas: float = Field(default=3.0, gt=0.0)
    """… and goes on as long as it lies deeper by this many …"""
    min_valley_m: float = Field(default=0.0004, ge=0.0)
    """… and by this much (m), as the mean over the cells of the line: a crack narrower than a cell looks shallow."""
    nearby_share: float = Field(default=0.25, ge=0.0, lt=1.0)
    """A cell is no crack if its line is less than this share as deep as the deepest within the length of a line."""
    spur_m: float = Field(default=0.04, ge=0.0, le=0.5)
    """Side branches shorter than this (m) are frays of a crack's wall, and left out."""

    @model_validator(mode="after")
    def _in_order(self) -> CrackDetection:
        if self.weak_sigmas > self.strong_sigmas:
            raise ValueError(f"weak_sigmas {self.weak_sigmas:g} is above strong_sigmas {self.strong_sigmas:g}")
        return self


class CrackJoining(Strict):
    """What is a crack once its pieces are joined over all tiles, and of which type (``crack_network.py``)."""

    min_length_m: float = Field(default=0.15, ge=0.0)
    """Least length of a crack with all its branches, over all tiles (m)."""
    min_depth_m: float = Field(default=0.001, ge=0.0)
    """Least mean depth of a crack (m): of each row by itself, so a shallow branch of another type is left out, and a
    deep one stays in a network of shallow ones."""
    bridge_m: float = Field(default=0.1, ge=0.0, le=1.0)
    """Two ends that point at one another are one crack if they are no farther apart (m); 0: gaps stay."""
    lane_angle_deg: float = Field(default=30.0, gt=0.0, le=45.0)
    """A crack within this angle of the lane's direction is longitudinal, within this of its normal transverse, else
    diagonal (degrees)."""
    alligator_polygons: int = Field(default=3, ge=1)
    """A net of cracks that closes at least this many polygons …"""
    alligator_nodes_per_m2: float = Field(default=4.0, gt=0.0)
    """… and has this many junctions per square metre of the ground that it covers is an alligator crack."""


class PotholeDetection(Strict):
    """Where a surface may have potholes (``potholes.py``)."""

    block_m: float = Field(default=0.05, gt=0.0, le=0.5)
    """Edge of the blocks whose mean heights show the ground around (m)."""
    max_size_m: float = Field(default=1.5, gt=0.0, le=4.0)
    """Longest way across the largest pothole that is measured whole (m); of larger ones parts are missing. A tile looks
    1.3 times as far around itself, and 0.7 m."""
    edge_depth_m: float = Field(default=0.008, gt=0.0)
    """Depth below the ground at which a pothole's outline runs (m)."""
    min_depth_m: float = Field(default=0.02, gt=0.0)
    """Least depth of the deepest block (m): settled patches and sunk manholes are mostly less."""
    min_wall_slope: float = Field(default=0.08, ge=0.0)
    """Least slope (m/m, over three blocks) that most of a pothole's walls have somewhere: what sinks more gently is a
    hollow of an uneven road."""

    @model_validator(mode="after")
    def _in_order(self) -> PotholeDetection:
        if self.edge_depth_m > self.min_depth_m:
            raise ValueError(f"edge_depth_m {self.edge_depth_m:g} is above min_depth_m {self.min_depth_m:g}")
        return self


class PotholeJoining(Strict):
    """What is a pothole once its pieces are joined over all tiles."""

    min_depth_m: float = Field(default=0.02, gt=0.0)
    """Least depth of its deepest block (m); below that of the detection it changes nothing."""
    min_area_m2: float = Field(default=0.005, gt=0.0)
    """Least area (m²)."""
    max_elongation: float = Field(default=4.0, ge=1.0)
    """Longer than this many times the diameter of the largest circle in it, it is a rut or a trench."""
