"""Runs commands in forks of one process that has imported all that they need, and kills some of them on the way.

A line on standard input is a JSON object: `command`, the words after ``roadscan`` (or `stage`, a stage's name and the
survey file); `folder`, in which it runs; `log`, a file for what it says; `seconds` of processor time, or `writes` of
the file system or the object store, after which SIGKILL ends it (left out: it lives); or `wall_s`, seconds after which
SIGKILL ends it, or with `of_worker` one of its workers. A line on standard output tells how it `ended` (``killed``, or
the exit status), the `seconds` that it took, its `writes`, and how many of its workers were `left` behind.

Times that commands write into files are always the same, so that files can be compared to the byte.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import mmap
import os
import signal
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import psutil

from roadscan.cli import main
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.survey.run import run_stages

_CHANGES: Final = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate"}
"""Audit events of Python that change the file system, beside `open` for writing."""
_PUTS: Final = {"put_object", "delete_object", "delete_objects", "copy_object", "upload_part",
                "create_multipart_upload", "complete_multipart_upload"}  # fmt: skip
"""Requests that change an object store."""
_TIMED: Final = ("roadscan.core.gpstime", "roadscan.store.asset_truth", "roadscan.survey.archive")
"""Modules that write the present instant into files."""
_LOOKS_S: Final = 0.004
"""Time between looks at the processor time of a command (s)."""


_LONGEST_END_S: Final = 30.0
"""Time within which workers end after their run (s)."""


class _Fixed(datetime.datetime):
    """A clock that stands."""

    @classmethod
    def now(cls, tz: datetime.tzinfo | None = None) -> datetime.datetime:  # type: ignore[override]
        """Return the same instant always."""
        return datetime.datetime(2026, 11, 1, 12, tzinfo=tz)


class _Clock(ModuleType):
    """`datetime` with that clock."""

    def __getattr__(self, name: str) -> Any:
        return _Fixed if name == "datetime" else getattr(datetime, name)


class Writes:
    """Counts what a process changes, in memory that its parent sees, and ends it before one of them."""

    def __init__(self) -> None:
        self.shared = mmap.mmap(-1, 8)
        self.last: int | None = None
        self.folder = ""

    @property
    def count(self) -> int:
        return int.from_bytes(self.shared[:8], "little")

    def begin(self, folder: str, last: int | None) -> None:
        """Count in this process: files below a folder, and objects."""
        self.folder, self.last = folder, last
        sys.addaudithook(self._heard)
        import s3fs
        from fsspec.asyn import sync_wrapper

        call = s3fs.S3FileSystem._call_s3

        async def counted(fs: Any, method: str, *args: Any, **kwargs: Any) -> Any:
            if method in _PUTS:
                self.step()
            return await call(fs, method, *args, **kwargs)

        s3fs.S3FileSystem._call_s3 = counted
        s3fs.S3FileSystem.call_s3 = sync_wrapper(counted)  # files that are written as streams call this one

    def step(self) -> None:
        """Count one, or die."""
        self.shared[:8] = (self.count + 1).to_bytes(8, "little")
        if self.last is not None and self.count >= self.last:
            os.kill(os.getpid(), signal.SIGKILL)

    def _heard(self, event: str, args: tuple[Any, ...]) -> None:
        if event in _CHANGES or (
            event == "open" and args[2] is not None and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        ):
            # Names without a root count from the folder, in which the command runs.
            names = [os.fsdecode(one) for one in args[:2] if isinstance(one, (str, bytes, os.PathLike))]
            if any(name[:1] != "/" or name.startswith(self.folder) for name in names[:2]):
                self.step()


def done(asked: dict[str, Any]) -> dict[str, Any]:
    """What became of a command."""
    writes = Writes()
    child = os.fork()
    if child == 0:
        _run(asked, writes)
    used, seconds, wall_s = psutil.Process(child), asked.get("seconds"), asked.get("wall_s")
    ended, last_s, began_s = None, 0.0, time.monotonic()
    workers: list[psutil.Process] = []
    killed = 0
    while ended is None:
        if wall_s is not None and not killed and time.monotonic() - began_s >= wall_s:
            workers = _workers(used)
            victim = (workers or [None])[int(1e3 * wall_s) % max(len(workers), 1)] if asked.get("of_worker") else used
            if victim is not None:
                with contextlib.suppress(psutil.NoSuchProcess):
                    victim.kill()
                    killed = 1
        with contextlib.suppress(psutil.NoSuchProcess):
            last_s = sum(used.cpu_times()[:2])
        if seconds is not None and last_s >= seconds:
            os.kill(child, signal.SIGKILL)
            ended = _status(child, 0)
            break
        ended = _status(child, os.WNOHANG)
        if ended is None:
            time.sleep(_LOOKS_S)
    _, left = psutil.wait_procs(workers, timeout=_LONGEST_END_S)
    return {"ended": ended, "seconds": last_s, "writes": writes.count, "left": len(left), "killed": killed}


def _workers(run: psutil.Process) -> list[psutil.Process]:
    """Workers of a run, and what else it started."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return [one for one in run.children(recursive=True) if "spawn_main" in " ".join(one.cmdline())]
    return []


def _run(asked: dict[str, Any], writes: Writes) -> None:
    status = 1
    with Path(asked["log"]).open("w", encoding="utf-8") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    try:
        sys.argv = ["roadscan", *asked["command"]]
        os.chdir(asked["folder"])
        writes.begin(asked["folder"], asked.get("writes"))
        _run_stage(*asked["command"][1:]) if asked["command"][0] == "stage" else main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _run_stage(name: str, survey_file: str) -> None:
    """Run one stage as `roadscan run` does it; no command runs each of them alone, and the report after none."""
    session = Session.open(survey_file)
    run_stages(session, [stage_named(name)])
    raise SystemExit(0)


def _status(child: int, options: int) -> str | None:
    ended, status = os.waitpid(child, options)
    if not ended:
        return None
    return "killed" if os.WIFSIGNALED(status) else str(os.WEXITSTATUS(status))


def _prepare() -> None:
    """Import what commands need."""
    import importlib

    import s3fs  # noqa: F401

    from roadscan.ingest.reading.format import log_formats
    from roadscan.report.section import sections
    from roadscan.run.stage import stages
    from roadscan.site.document import site_parts
    from roadscan.tiles.product import products

    assert stages() and log_formats() and products() and sections() and site_parts()
    for name in _TIMED:
        vars(importlib.import_module(name))["dt"] = _Clock("datetime")


if __name__ == "__main__":
    _prepare()
    for line in sys.stdin:
        sys.stdout.write(f"{json.dumps(done(json.loads(line)))}\n")
        sys.stdout.flush()
