"""Files that are replaced as a whole."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from roadscan.core.errors import ConfigError


def replace_file(file: Path, content: bytes) -> None:
    """Write a file, or replace it, atomically and durably: readers see the old content or the new.

    Raises
    ------
    ConfigError
        where it cannot be written; it then stays as it was.
    """
    target = file.resolve()
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        if target.exists():
            temporary.chmod(target.stat().st_mode & 0o7777)
        temporary.replace(target)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise ConfigError(f"the file cannot be written ({error})", file=file) from error
