"""Errors of inertial measurement units: by grade, or as a data sheet states them."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import Field

from roadscan.core.strict import Strict

STANDARD_GRAVITY_M_PER_S2: Final = 9.80665
"""Size of the unit g (CGPM 1901), and the gravity of local frames."""
ImuGrade = Literal["perfect", "navigation", "tactical", "industrial", "mems"]
"""How good an inertial measurement unit is."""


class ImuErrors(Strict):
    """Errors of an inertial measurement unit, 1 σ; biases change as Gauss–Markov processes."""

    gyro_noise_deg_per_sqrt_h: float = Field(ge=0.0)
    """Angle random walk."""
    gyro_bias_deg_per_h: float = Field(ge=0.0)
    """Bias of each gyroscope."""
    gyro_scale_ppm: float = Field(ge=0.0)
    """Scale error of each gyroscope."""
    accel_noise_ug_per_sqrt_hz: float = Field(ge=0.0)
    """Velocity random walk, as noise density of the accelerometers (µg/√Hz)."""
    accel_bias_mg: float = Field(ge=0.0)
    """Bias of each accelerometer (mg)."""
    accel_scale_ppm: float = Field(ge=0.0)
    """Scale error of each accelerometer."""
    bias_time_constant_s: float = Field(default=600.0, gt=0.0)
    """Time constant of the biases (s)."""


IMU_GRADES: Final[dict[ImuGrade, ImuErrors]] = {
    "perfect": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.0,
        gyro_bias_deg_per_h=0.0,
        gyro_scale_ppm=0.0,
        accel_noise_ug_per_sqrt_hz=0.0,
        accel_bias_mg=0.0,
        accel_scale_ppm=0.0,
    ),
    "navigation": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.002,
        gyro_bias_deg_per_h=0.005,
        gyro_scale_ppm=5.0,
        accel_noise_ug_per_sqrt_hz=10.0,
        accel_bias_mg=0.03,
        accel_scale_ppm=50.0,
        bias_time_constant_s=3600.0,
    ),
    "tactical": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.07,
        gyro_bias_deg_per_h=1.0,
        gyro_scale_ppm=150.0,
        accel_noise_ug_per_sqrt_hz=50.0,
        accel_bias_mg=1.0,
        accel_scale_ppm=300.0,
    ),
    "industrial": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.2,
        gyro_bias_deg_per_h=10.0,
        gyro_scale_ppm=500.0,
        accel_noise_ug_per_sqrt_hz=60.0,
        accel_bias_mg=3.0,
        accel_scale_ppm=1000.0,
    ),
    "mems": ImuErrors(
        gyro_noise_deg_per_sqrt_h=0.4,
        gyro_bias_deg_per_h=100.0,
        gyro_scale_ppm=3000.0,
        accel_noise_ug_per_sqrt_hz=150.0,
        accel_bias_mg=10.0,
        accel_scale_ppm=3000.0,
    ),
}
"""Errors by grade, the orders of magnitude of Groves (2013), table 4.1 and 4.2."""
