"""Records of pictures of navigation, clocks and calibration, like those of all other outputs.

Each has a record in the manifest with its digest and a key of what it shows, so that `roadscan verify` sees damage and
the next run draws what is missing, damaged or out of date, and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final

from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.store.digest import file_digest
from roadscan.store.manifest import Manifest, OutputRecord
from roadscan.store.store import Store

NAVIGATION_PICTURE: Final = "navigation_picture"
CLOCK_PICTURE: Final = "clock_picture"
CALIBRATION: Final = "calibration"
"""Products of the records."""
NOT_DRAWN: Final = "not drawn"
"""Key of the record of a picture that was left out for want of Matplotlib."""
_DRAWN_BY: Final = ("roadscan.calibrate.picture", "roadscan.navigation.clocks.picture", "roadscan.navigation.picture")


def picture_key(*shown: object) -> str:
    """Return the key of a picture: hash of its content and of the code that draws it."""
    return key_of(code_digest(*_DRAWN_BY), *shown)


def keep_file(
    store: Store,
    manifest: Manifest,
    output: tuple[str, str],
    key: str,
    target: str,
    write: Callable[[Path], None],
    detail: str = "",
) -> None:
    """Write a file, publish it and record it.

    Parameters
    ----------
    output : product and unit of the record; `target` : path relative to the survey's root.
    write : writes the file to the path it is given.
    detail : of the record.
    """
    with store.scratch() as folder:
        file = folder / Path(target).name
        write(file)
        size, digest = file.stat().st_size, file_digest(file)
        store.publish(file, target)
    manifest.add([OutputRecord(*output, key, target, size, digest, detail)])


def remove_others(manifest: Manifest, product: str, units: Collection[str]) -> None:
    """Remove the files of all units of a product except these."""
    manifest.remove(manifest.beside([product], units))
