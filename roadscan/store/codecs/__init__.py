"""Encoders and decoders of file formats: the only place that knows the layout of pages, blocks and checksums."""

from __future__ import annotations

from typing import Final

import roadscan

SOFTWARE: Final = "roadscan " + ".".join(roadscan.__version__.split(".")[:2])
"""Program and version as written into files."""
