"""A PostgreSQL server of the tests' own on loopback, with PostGIS."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

WANTED = "PostgreSQL with PostGIS is not installed: `apt-get install postgresql postgresql-postgis`"


def programs() -> Path | None:
    """Folder of PostgreSQL's programs, None where it is not installed."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb")) or [Path(p) for p in [shutil.which("initdb")] if p]
    return found[-1].resolve().parent if found else None


@contextmanager
def server() -> Iterator[str]:
    """Address of a fresh database; its server ends with the block."""
    folder_of_programs = programs()
    if folder_of_programs is None or not list(Path("/usr/share/postgresql").glob("*/extension/postgis.control")):
        pytest.skip(WANTED)
    user = "postgres" if os.geteuid() == 0 else None  # it refuses to run as root
    folder = Path(tempfile.mkdtemp(prefix="roadscan-pg-", dir="/tmp"))
    try:
        if user is not None:
            shutil.chown(folder, user)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]

        def call(*words: str) -> None:
            subprocess.run(
                [str(folder_of_programs / words[0]), *words[1:]], check=True, capture_output=True, user=user, cwd=folder
            )

        data = str(folder / "data")
        call("initdb", "-D", data, "-U", "admin", "--auth=trust", "--no-sync", "-E", "UTF8")
        options = f"-c listen_addresses=127.0.0.1 -c port={port} -c unix_socket_directories='' -c fsync=off"
        call("pg_ctl", "-D", data, "-w", "-l", str(folder / "log"), "-o", options, "start")
        try:
            yield f"postgresql://admin:secret@127.0.0.1:{port}/postgres"
        finally:
            call("pg_ctl", "-D", data, "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
