"""Pictures from their files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from roadscan.compute.array_types import UInt8
from roadscan.core.extras import cv2
from roadscan.store.codecs.image_files import ImageError, image_size


def read_picture(path: Path, size_px: tuple[int, int], *, grey: bool = False) -> UInt8:
    """Returns a decoded picture (height, width, 3; red first) or its grey values (height, width), in the orientation of
    the sensor, whatever its orientation tag.

    Parameters
    ----------
    size_px : width and height that it has to have: those of its lens.

    Raises
    ------
    ImageError
        It is cut short, of another size, or cannot be decoded.
    OSError
        It cannot be read.
    """
    size = image_size(path)  # detects truncated files, which a decoder would fill up
    if (size.width_px, size.height_px) != size_px:
        raise ImageError(f"{size.width_px} × {size.height_px} pixels, not {size_px[0]} × {size_px[1]}")
    content = np.frombuffer(path.read_bytes(), np.uint8)
    colours = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
    picture = cv2.imdecode(content, colours | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None or picture.shape[:2] != size_px[::-1]:
        raise ImageError("the image cannot be decoded")
    return np.asarray(picture if grey else np.ascontiguousarray(picture[:, :, ::-1]), np.uint8)
