"""Rule for the pictures that may show assets."""

from __future__ import annotations

from typing import Final

from roadscan.assets.pictures.settings import AssetPicturesSettings
from roadscan.pictures.views import PictureRule

_ANY_ANGLE_DEG: Final = -90.0  # Least angle below the horizon: any (degrees).
_BORDER_PX: Final = 1  # Border of a picture that is not used (pixels).


def picture_rule(settings: AssetPicturesSettings) -> PictureRule:
    """Returns the rule: pictures of the cameras that are asked for, within reach, at any angle."""
    return PictureRule(tuple(settings.cameras), settings.reach_m, _ANY_ANGLE_DEG, _BORDER_PX)
