"""Programs that work on an inventory and die of it: between two writes, or by kill −9 at any moment.

`main` does the jobs of its standard input, a line each, in forks of one process that has imported
all that they need, and kills some of them on the way. Its answers, a line each: ``killed``, or the exit status.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from roadscan.inventory.home import Content, Home, Mark
from roadscan.inventory.inventory import Inventory
from roadscan.inventory.recording import Found, Rules
from roadscan.inventory.settings import Matching
from roadscan.store.asset_truth import AssetTruth
from roadscan.store.store import Store
from tests.inventory.streets import Everywhere

LOOKS_S = 0.002


class Killed(BaseException):
    """A program ends at once: nothing that it had planned to do is done."""


class Death:
    """When this process dies: at which of its writes, and how."""

    left: int | None = None
    """Writes until then, each of which counts before and after; None where it lives."""
    is_real = False

    @classmethod
    def step(cls) -> None:
        """Die here, or somewhat later."""
        if cls.left is None:
            return
        cls.left -= 1
        if cls.left < 0:
            if cls.is_real:
                os.kill(os.getpid(), signal.SIGKILL)
            raise Killed


class DyingStore(Store):
    """A store whose program dies at one of its writes: before it, or when the bytes lie in a scratch file."""

    def write_bytes(self, relative: str, content: bytes, *, lasting: bool = True) -> None:
        Death.step()
        super().write_bytes(relative, content, lasting=lasting)
        Death.step()


class DyingHome(Home):
    """A home whose program dies before or after it writes to it."""

    def __init__(self, inner: Home) -> None:
        self.inner = inner

    @property
    def name(self) -> str:
        return self.inner.name

    def mark(self) -> Mark | None:
        return self.inner.mark()

    def read(self) -> Content:
        return self.inner.read()

    def write(self, content: Content, sheets: Any, mark: Mark) -> None:
        Death.step()
        self.inner.write(content, sheets, mark)
        Death.step()

    def note(self, mark: Mark) -> None:
        Death.step()
        self.inner.note(mark)
        Death.step()


class Work(NamedTuple):
    """What a program does: take in what was found; pull; pull and publish."""

    found: Found | None = None
    publish: bool = False

    def do(self, inventory: Inventory) -> None:
        """Do it."""
        if self.found is not None:
            inventory.record(self.found)
            return
        if not self.publish or inventory.home.mark() is not None:
            inventory.pull(who="eva", confirm=("all",))
        if self.publish:
            inventory.publish()


def inventory_of(folder: Path, home: Home) -> Inventory:
    """The inventory of a folder, opened anew, as by another program."""
    truth = AssetTruth(DyingStore(str(folder / "store"), "street"))
    return Inventory(truth, DyingHome(home), "street", Rules(Everywhere(), Matching()))


class Job(NamedTuple):
    """A work in a process of its own, and after which write or how much processor time (s) that is killed."""

    folder: Path
    home: Home
    work: Work
    writes: int | None = None
    seconds: float | None = None

    def killed(self) -> str:
        """How it ended."""
        child = os.fork()
        if child == 0:
            self._run()
        if self.seconds is not None:
            used = psutil.Process(child)
            while sum(used.cpu_times()[:2]) < self.seconds:
                if (status := _status_of(child, os.WNOHANG)) is not None:
                    return status
                time.sleep(LOOKS_S)
            os.kill(child, signal.SIGKILL)
        return _status_of(child, 0) or "killed"

    def _run(self) -> None:
        status = 1
        try:
            Death.left, Death.is_real = self.writes, True
            self.work.do(inventory_of(self.folder, self.home))
            status = 0
        except Exception:  # noqa: BLE001
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)


def _status_of(child: int, options: int) -> str | None:
    done, status = os.waitpid(child, options)
    if not done:
        return None
    return "killed" if os.WIFSIGNALED(status) else str(os.WEXITSTATUS(status))


class Programs:
    """The process whose forks do the jobs."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process

    def run(self, job: Job) -> bool:
        """Whether the job was killed; it must not end otherwise than well."""
        assert self.process.stdin is not None and self.process.stdout is not None
        print(pickle.dumps(job).hex(), file=self.process.stdin, flush=True)
        status = self.process.stdout.readline().strip()
        assert status in ("0", "killed"), status
        return status == "killed"


@contextmanager
def programs() -> Iterator[Programs]:
    """A process that does jobs until the block ends."""
    words = [sys.executable, "-c", "from tests.inventory.dying import main; main()"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield Programs(process)
        finally:
            assert process.stdin is not None
            process.stdin.close()


def main() -> None:
    """Do the jobs of standard input."""
    for line in sys.stdin:
        job: Job = pickle.loads(bytes.fromhex(line))
        sys.stdout.write(f"{job.killed()}\n")
        sys.stdout.flush()
