"""Services of deploy/compose.yaml, started as processes: each on a host of its own, by the file's own commands."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.conftest import REPOSITORY
from tests.hosts.host import USER, Host, Network, Running

FILE = REPOSITORY / "deploy" / "compose.yaml"
HEALTHY_S = 120.0


def interpolated(settings: dict[str, str]) -> str:
    """The file with its variables filled in, as compose does it before it reads the file."""

    def value(found: re.Match[str]) -> str:
        name, kind, other = found.groups()
        if settings.get(name):
            return settings[name]
        assert kind != ":?", f"{name}: {other}"
        return other

    return re.sub(r"\$\{(\w+)(:[-?])([^}]*)\}", value, FILE.read_text())


@dataclass
class Composed:
    """The services that are wanted, in the order in which they depend on one another."""

    net: Network
    stack: ExitStack
    settings: dict[str, str]
    kernels: Path
    given: dict[str, list[str]]
    """Commands of services whose image is not roadscan's: what stands for them here."""
    search_path: str
    edited: dict[str, Path] = field(default_factory=dict)
    """Files of deploy/ that a user has edited: what is mounted in their place."""
    hosts: dict[str, Host] = field(default_factory=dict)
    running: dict[str, Running] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.services: dict[str, dict[str, Any]] = yaml.safe_load(interpolated(self.settings))["services"]

    def up(self, wanted: list[str]) -> None:
        """Start services, each when those that it depends on are as it asks."""
        for service in wanted:
            for replica in range(self.services[service].get("deploy", {}).get("replicas", 1)):
                self._make(service, replica)
        for name in self.hosts:
            for needed, asked in self.services[_service(name)].get("depends_on", {}).items():
                self._wait(needed, asked["condition"])
            self.start(name)

    def start(self, name: str) -> Running:
        """Start a service's process; again, where it had ended."""
        host, service = self.hosts[name], self.services[_service(name)]
        command = self.given.get(name) or service["command"]
        self.running[name] = self.stack.enter_context(
            host.running(command, self._environment(service), f"log-{time.time_ns()}")
        )
        return self.running[name]

    def _make(self, service: str, replica: int) -> None:
        name = service if replica == 0 else f"{service}.{replica + 1}"
        host = self.net.host(name)
        has_home = any(":/var/lib/roadscan" in one or one == "/var/lib/roadscan" for one in self._volumes(service))
        if has_home and service in ("worker", "dask-worker"):
            host.give_kernels(self.kernels)
        for volume in self._volumes(service):
            source, _, rest = volume.partition(":")
            inside, _, mode = rest.partition(":")
            if inside and inside != "/var/lib/roadscan":
                host.give(inside, self._source(source))
                host.only_read |= {inside} if mode == "ro" else set()
        self.hosts[name] = host

    def _volumes(self, service: str) -> list[str]:
        return list(self.services[service].get("volumes", []))

    def _source(self, source: str) -> Path:
        if source in self.edited:
            return self.edited[source]
        if source.startswith("."):
            return (FILE.parent / source).resolve()
        if source.startswith("/"):
            return Path(source)
        folder = self.net.folder / "volumes" / source
        if not folder.exists():
            folder.mkdir(parents=True, mode=0o700)
            os.chown(folder, USER, USER)
        return folder

    def _environment(self, service: dict[str, Any]) -> dict[str, str]:
        image = re.search(r"^ENV (.*?)^USER", (REPOSITORY / "deploy/Containerfile").read_text(), flags=re.M | re.DOTALL)
        assert image is not None
        of_image = dict(re.findall(r"(\w+)=(\S+)", image[1]))
        stated = {name: str(value) for name, value in service.get("environment", {}).items()}
        here = {"PATH": self.search_path, "PYTHONPATH": str(REPOSITORY), "LANG": "C.UTF-8"}
        here |= {
            name: value for name, value in os.environ.items() if name.startswith("OPENBLAS_")
        }  # they move last bits
        return of_image | here | stated

    def _wait(self, needed: str, condition: str) -> None:
        if condition == "service_completed_successfully":
            assert self.running[needed].ended(HEALTHY_S) == 0, self.running[needed].said()
        elif condition == "service_healthy":
            test = self.services[needed]["healthcheck"]["test"]
            assert test[0] == "CMD"
            self.running[needed].wait_until(
                lambda: self._is_healthy(needed, test[1:]), f"{needed} does not become healthy", HEALTHY_S
            )

    def _is_healthy(self, name: str, test: list[str]) -> bool:
        entered, entering = self.hosts[name].command(test, self._environment(self.services[_service(name)]))
        return subprocess.run(entered, env=entering, capture_output=True, check=False).returncode == 0


def _service(name: str) -> str:
    return name.partition(".")[0]


def eventually(look: Callable[[], bool], complaint: str, within_s: float) -> None:
    """Wait until something holds."""
    end = time.monotonic() + within_s
    while not look():
        if time.monotonic() > end:
            pytest.fail(complaint)
        time.sleep(0.5)
