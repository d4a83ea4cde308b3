"""How well cameras are known before the adjustment estimates what is wrong with them."""

from __future__ import annotations

from pydantic import Field

from roadscan.core.strict import Strict


class CameraPriors(Strict):
    """How well cameras are known whose pictures have tie points.

    σ that the rig file states (`lever_arm_sigma_m`, `boresight_sigma_deg`, `sigma_focal_px` and those beside it) stand
    in place of these. What has a σ of 0 is not estimated.
    """

    sigma_lever_m: float = Field(default=0.02, ge=0.0, le=1.0)
    """1 σ of the lever arm on each axis (m)."""
    sigma_boresight_deg: float = Field(default=0.5, ge=0.0, le=10.0)
    """1 σ of the boresight about each axis (degrees); where range edges show a larger turn, that turn."""
    sigma_focal: float = Field(default=0.003, ge=0.0, le=0.1)
    """1 σ of the focal length, as a share of it."""
    sigma_principal: float = Field(default=0.001, ge=0.0, le=0.1)
    """1 σ of each coordinate of the principal point, as a share of the focal length. On a straight drive it can hardly
    be told from the boresight; were it not estimated, its error would be in the boresight, whose σ would not say so."""
    sigma_k1: float = Field(default=0.002, ge=0.0, le=1.0)
    """1 σ of the radial distortion k1. The other parameters of the distortion are estimated only where the rig file
    states their σ."""
    sigma_clock_s: float = Field(default=0.0, ge=0.0, le=1.0)
    """1 σ of what the stamps of the pictures are off (s). 0: the stage `clocks` is to find it."""
    sigma_line_time_us: float = Field(default=0.0, ge=0.0, le=100.0)
    """1 σ of the time between two rows (µs), of cameras whose rig file states such a time."""
    sigma_shared_px: float = Field(default=0.01, ge=0.0, le=10.0)
    """1 σ of what all measurements of a picture are off in common (px): what the lens model leaves, and features that
    look different from nearer. Without it, thousands of tie points would believe their mean to hundredths of a pixel,
    and bend mountings, lens and control by what they share."""
    depths: bool = True
    """Whether tie points that lie on a surface which a lidar of the same run saw at the moment of the picture are held
    to it."""
    depth_every_m: float = Field(default=2.0, gt=0.0, le=100.0)
    """Pictures of a camera that far apart (m) are looked at for that."""
    depth_reach_m: float = Field(default=40.0, gt=1.0, le=200.0)
    """Returns of the lidar farther from the camera (m) are not used."""
    sigma_depth_m: float = Field(default=0.03, gt=0.0, le=1.0)
    """1 σ of the distance of a tie point from such a surface, beside the scatter of the returns (m)."""
    sigma_shared_depth_m: float = Field(default=0.01, ge=0.0, le=1.0)
    """1 σ of what all of them in a picture are off in common (m): ranges that depend on brightness, and beams."""
    edges: bool = True
    """Whether range edges of a lidar of the same run, held against edges of pictures, are an observation of the
    boresight."""
    sigma_shared_edge_deg: float = Field(default=0.05, gt=0.0, le=5.0)
    """1 σ of what all range edges are off in common (degrees), about each axis: beams are 0.1 to 0.2° wide."""
    sigma_control_px: float = Field(default=0.3, gt=0.0, le=10.0)
    """1 σ of each pixel coordinate of a control point, where the measurement states none (px)."""
