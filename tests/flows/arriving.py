"""A fleet whose folders of raw logs arrive, and a door at which messages are left."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

from roadscan.flows.arrival import arrival
from roadscan.flows.watch import watch
from roadscan.simulate import SimulatedSurvey
from tests.serving import serving

FLEET = """
rig = "RIG.toml"
quiet_min = {quiet_min}

[queues]
"urgent-*" = "urgent"

[survey.map]
crs = "EPSG:32632"

[logs.sbet]
crs = "EPSG:4979"
clock = {{ system = "gps_week_seconds", week = "overlap" }}
"""
"""Answers all that `roadscan init` asks of the simulated logs; the week follows from the profilers' stamps."""


class Fleet:
    """A watched folder, a folder of surveys and a template."""

    def __init__(self, folder: Path, simulated: SimulatedSurvey, *, together: bool = False) -> None:
        """`together`: surveys lie beside the watched folder, as deploy/arrival.yaml has it."""
        self.incoming, self.file = folder / "incoming", folder / "FLEET.toml"
        self.surveys = folder if together else folder / "surveys"
        self.simulated = simulated
        self.raw = simulated.folder / "raw"
        self.incoming.mkdir()
        self.surveys.mkdir(exist_ok=True)
        shutil.copy(simulated.folder / "RIG.toml", folder)
        self.state(quiet_min=0)

    def state(self, quiet_min: float) -> None:
        self.file.write_text(FLEET.format(quiet_min=quiet_min))

    def upload(self, name: str) -> Path:
        return Path(shutil.copytree(self.raw, self.incoming / name))

    def parameters(self, **more: object) -> dict[str, Any]:
        """Of both flows."""
        return {"watched": str(self.incoming), "fleet": str(self.file), "surveys": str(self.surveys)} | more

    def watch(self) -> dict[str, list[str]]:
        """What became of folders, where anything did."""
        found: dict[str, list[str]] = watch(**self.parameters())
        return {what: names for what, names in found.items() if names}

    def arrive(self, name: str, *after_s: float) -> None:
        arrival(**self.parameters(name=name, workers=0, retry_after_s=after_s))

    def knows(self, name: str) -> bool:
        """Whether anything is remembered of a folder."""
        return (self.surveys / ".arrivals" / f"{name}.json").is_file()

    def record(self, name: str) -> dict[str, Any]:
        """What is remembered of a folder."""
        found: dict[str, Any] = json.loads((self.surveys / ".arrivals" / f"{name}.json").read_text())
        return found


def manifest_of(folder: Path) -> bytes:
    """The list of files that an upload's first or last step writes."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    rows = [("name", "bytes", "sha256")]
    for file in files:
        content = file.read_bytes()
        rows.append((file.relative_to(folder).as_posix(), str(len(content)), hashlib.sha256(content).hexdigest()))
    return "".join(",".join(row) + "\n" for row in rows).encode()


class Mailbox:
    """A web server that keeps what is posted to it."""

    def __init__(self) -> None:
        self.letters: list[dict[str, Any]] = []
        letters = self.letters

        class Door(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                letters.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self.server = HTTPServer(("127.0.0.1", 0), Door)
        self.url = f"http://127.0.0.1:{self.server.server_port}/"

    def about(self, *words: str) -> list[dict[str, Any]]:
        """Letters whose subject holds all words."""
        return [one for one in list(self.letters) if all(word in one["subject"] for word in words)]


@contextmanager
def open_mailbox() -> Iterator[Mailbox]:
    """One that is open for as long as the context lasts."""
    box = Mailbox()
    with serving(box.server):
        yield box
