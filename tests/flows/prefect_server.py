"""A Prefect server of the tests' own, and other processes that end with the test."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class PrefectApi:
    """A Prefect server on this machine."""

    url: str
    environment: dict[str, str]
    """For processes that use it."""

    def command(self, *arguments: str) -> list[str]:
        """A command of the Prefect command line."""
        return [sys.executable, "-m", "prefect", "--no-prompt", *arguments]

    def call(self, *arguments: str, cwd: Path, **environment: str) -> str:
        """Run a command of the Prefect command line to its end; what it printed."""
        done = subprocess.run(
            self.command(*arguments), cwd=cwd, env=self.environment | environment, check=False,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=START_TIMEOUT_S,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
        return done.stdout


@contextlib.contextmanager
def background(
    command: list[str], environment: dict[str, str], cwd: Path, log: Path
) -> Iterator[subprocess.Popen[bytes]]:
    """A process, with all processes that it starts, for as long as the context lasts."""
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        with contextlib.suppress(ProcessLookupError):  # what it may have left behind
            os.killpg(process.pid, signal.SIGKILL)


@contextlib.contextmanager
def running_server(folder: Path) -> Iterator[PrefectApi]:
    """A server that keeps all that it writes in `folder`; it starts in 5 to 20 s."""
    port = _free_port()
    url = f"http://127.0.0.1:{port}/api"
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_")} | {
        "PREFECT_HOME": str(folder),
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        # As docs/deployment.md sets them: each death is told in two minutes.
        "PREFECT_SERVER_EVENTS_CAUSAL_ORDERING": "roadscan.flows.ordering",
        "PREFECT_SERVER_EVENTS_EXPIRED_BUCKET_BUFFER": "P30D",
    }
    log = folder / "server.log"
    api = PrefectApi(url, environment | {"PREFECT_API_URL": url})
    command = api.command("server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui")
    with background(command, environment, folder, log) as process:
        _wait_until_healthy(url, process, log)
        yield api


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_until_healthy(url: str, process: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < end:
        with contextlib.suppress(OSError), urllib.request.urlopen(f"{url}/health", timeout=5.0):
            return
        if process.poll() is not None:
            break
        time.sleep(0.2)
    pytest.fail(f"the Prefect server did not start:\n{log.read_text()}")
