"""The bytes of file formats: the only room that knows how a page, a block, a directory or a checksum is laid out."""

from __future__ import annotations

from typing import Final

import roadscan

SOFTWARE: Final = "roadscan " + ".".join(roadscan.__version__.split(".")[:2])
"""Program and version as the files name it."""
