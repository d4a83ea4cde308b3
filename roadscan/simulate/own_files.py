"""The files of a simulated survey that a user may edit: edited ones are not overwritten."""

from __future__ import annotations

import contextlib
import hashlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from roadscan.core.errors import ConfigError
from roadscan.simulate.files import CONTROL_FILE, RIG_FILE, SURVEY_FILE
from roadscan.simulate.truth import TRUTH_FOLDER

_WRITTEN: Final = "written.json"
"""File in the truth folder with digests of the files as the simulator wrote them."""
_EDITED: Final = (RIG_FILE, CONTROL_FILE, SURVEY_FILE)


def refuse_edited(folder: Path) -> None:
    """Raise :class:`ConfigError` if a user edited a file of the simulated survey in `folder`."""
    record = folder / TRUTH_FOLDER / _WRITTEN
    written = json.loads(record.read_bytes()) if record.is_file() else {}
    arrived = "the file was edited since the simulator wrote it"
    if not written:
        arrived = "nothing tells whether the file was edited: it is not of this version of the simulator"
    for name in _EDITED:
        file = folder / name
        if file.is_file() and _digest(file) not in written.get(name, []):
            raise ConfigError(
                arrived,
                expected="a new or empty folder, or a survey as it was simulated",
                change="name another folder, or add --force to overwrite it",
                file=file,
            )


@contextlib.contextmanager
def written_for_the_user(folder: Path) -> Iterator[Path]:
    """Return a folder for the files; at the end their digests are stored, and they are moved to `folder`.

    If it is interrupted, both the old and the new digests are stored.
    """
    record = folder / TRUTH_FOLDER / _WRITTEN
    with tempfile.TemporaryDirectory(dir=folder / TRUTH_FOLDER) as scratch:
        yield Path(scratch)
        new = {name: Path(scratch) / name for name in _EDITED}
        written = {name: [_digest(file)] for name, file in new.items()}
        old = {name: [_digest(folder / name)] for name in _EDITED if (folder / name).is_file()}
        record.write_text(json.dumps({name: written[name] + old.get(name, []) for name in _EDITED}, indent=1) + "\n")
        for name, file in new.items():
            file.replace(folder / name)
        record.write_text(json.dumps(written, indent=1) + "\n")


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
