"""Settings of pictures of assets (``[assets.pictures]``)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from roadscan.core.strict import Strict


class AssetPicturesSettings(Strict):
    """Which pictures show assets, and what is looked for in them."""

    on: bool = True
    """Name the pictures that show each asset best, and look at them. Without cameras nothing is named."""
    cameras: list[str] = []
    """Cameras of the rig whose pictures count; all of them where empty."""
    reach_m: float = Field(default=40.0, gt=1.0, le=200.0)
    """Farthest distance from a camera to an asset (m)."""
    most: int = Field(default=3, ge=1, le=10)
    """How many pictures are named for an asset, at most."""
    cut_outs: bool = True
    """Keep the part of each of these pictures that shows a sign, as a JPEG file."""
    margin: float = Field(default=0.25, ge=0.0, le=2.0)
    """How far a cut-out reaches beyond the sign on each side, as a share of its size."""
    text: bool = False
    """Read the text on signs; needs the extra `ocr` (pip install "roadscan[ocr]")."""
    sign_types: Literal["both", "vienna", "mutcd", "off"] = "both"
    """Tell the types of signs with the recogniser that comes with roadscan: of the set that the country has, of both
    sets, or not at all. docs/assets.md lists the types."""
    recogniser: Path | None = None
    """ONNX model of your own that tells the type of a sign from its cut-out; needs the extra `onnx`. It goes before the
    recogniser that comes with roadscan. docs/assets.md says what it gets and gives."""
