"""Settings of the post-processing of raw GNSS observations (``[navigation.ppk]``, options of the format `ppk`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import Field, model_validator

from roadscan.core.strict import Strict, pattern_in_words

ANTENNA_HEIGHT_MAX_M: Final = 100.0
"""No antenna stands higher above its mark (m): a larger number is in another unit."""

_SYSTEMS: Final = pattern_in_words(
    "^[GREJC]+$", "letters of satellite systems: G GPS, R GLONASS, E Galileo, J QZSS, C BeiDou"
)
_GEOCENTRIC: Final = ("x_m", "y_m", "z_m")
_GEODETIC: Final = ("latitude_deg", "longitude_deg", "height_m")


class PpkBase(Strict):
    """The base station."""

    files: list[Path] = Field(min_length=1)
    """Its observations (RINEX 2 or 3, or UBX), several where it changes its file: paths relative to the survey file in
    `[navigation.ppk]`, to the rover's folder in a log's options."""
    crs: str
    """CRS of its position, geocentric (such as "EPSG:7930", ETRF2000) or geographic with ellipsoidal heights
    ("EPSG:7931"); the solution is in its datum."""
    epoch: float | None = Field(default=None, ge=1980.0, le=2200.0)
    """Epoch of its position (decimal year); required where the datum's coordinates move with time, as those of ITRF and
    WGS 84 do."""
    x_m: float | None = None
    """Geocentric X of the mark (m)."""
    y_m: float | None = None
    """Geocentric Y (m)."""
    z_m: float | None = None
    """Geocentric Z (m)."""
    latitude_deg: float | None = Field(default=None, ge=-90, le=90)
    """Geodetic latitude of the mark (degrees)."""
    longitude_deg: float | None = Field(default=None, ge=-180, le=360)
    """Longitude (degrees)."""
    height_m: float | None = None
    """Ellipsoidal height of the mark (m), without the antenna's."""
    antenna_height_m: float | None = Field(default=None, ge=-ANTENNA_HEIGHT_MAX_M, le=ANTENNA_HEIGHT_MAX_M)
    """Height of the antenna's reference point above the mark, vertically (m); 0 where the position is the antenna's.
    Always required."""
    antenna: str = ""
    """Type of the antenna as `antenna_calibration` names it, such as "TRM29659.00     NONE"."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = {name for name in (*_GEOCENTRIC, *_GEODETIC) if getattr(self, name) is not None}
        if given not in ({*_GEOCENTRIC}, {*_GEODETIC}):
            raise ValueError(
                f"the base's position is {', '.join(_GEOCENTRIC)} or {', '.join(_GEODETIC)}, all three of one kind"
            )
        return self

    @property
    def is_geocentric(self) -> bool:
        """Whether the position is X, Y, Z."""
        return self.x_m is not None

    @property
    def position(self) -> tuple[float, ...]:
        """X, Y, Z (m), or latitude (degrees), longitude (degrees), height (m)."""
        return tuple(getattr(self, name) for name in (_GEOCENTRIC if self.is_geocentric else _GEODETIC))


class PpkSettings(Strict):
    """Post-processing of a rover's observations against those of a base station, by RTKLIB."""

    base: PpkBase | None = None
    """The base station: files, position with its CRS and epoch, height of its antenna."""
    navigation: list[Path] = []
    """Navigation files (broadcast orbits) of the day; not needed where rover or base is UBX and recorded them."""
    precise: list[Path] = []
    """Precise orbits and clocks (SP3, CLK), used in place of the broadcast ones."""
    mode: Literal["kinematic", "static"] = "kinematic"
    """How the rover moves: on a vehicle, or not at all."""
    direction: Literal["combined", "forward", "backward"] = "combined"
    """Direction in which the observations are processed: combined takes both and is best. A combined solution is float
    where both directions are fixed and contradict each other."""
    antenna_height_m: float | None = Field(default=None, ge=-ANTENNA_HEIGHT_MAX_M, le=ANTENNA_HEIGHT_MAX_M)
    """Height of the rover's antenna above the point whose position is wanted (m): 0 for the antenna itself, from which
    the rig's lever arm counts. It may be left out, for 0, where the rover's file states none."""
    antenna: str = ""
    """Type of the rover's antenna as `antenna_calibration` names it."""
    antenna_calibration: Path | None = None
    """Phase centres of antennas (ANTEX, or NGS with the ending .pcv), for different antennas on rover and base."""
    systems: str = Field(default="GREJC", pattern=_SYSTEMS)
    """Satellite systems: G GPS, R GLONASS, E Galileo, J QZSS, C BeiDou."""
    frequencies: int = Field(default=2, ge=1, le=3)
    """Number of frequencies: 1 is L1/E1/B1, 2 adds L2/E5b/B2, 3 adds L5/E5a."""
    elevation_mask_deg: float = Field(default=15.0, ge=0.0, lt=90.0)
    """Satellites below this elevation are not used (degrees)."""
    ambiguities: Literal["off", "continuous", "instantaneous", "fix-and-hold"] = "continuous"
    """How whole numbers are found for the carrier phase's ambiguities; fix-and-hold keeps a wrong one longer."""
    ratio: float = Field(default=3.0, ge=1.0)
    """Least ratio of the second-best to the best set of ambiguities, for a position that is called fixed."""
    max_age_s: float = Field(default=30.0, gt=0.0)
    """Oldest base observation that is used for an epoch of the rover (s)."""

    def shaping(self) -> dict[str, Any]:
        """Return the settings for keys, with files by their names: their content is in the log's fingerprint."""
        return {name: _names(value) for name, value in self.model_dump().items()}


def _names(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _names(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_names(one) for one in value]
    return value.name if isinstance(value, Path) else value
