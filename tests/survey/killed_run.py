"""Runs the command line in forks of one process that has imported all that a run needs, and kills them on the way.

A line on standard input is the processor time (s) that a run has; a line on standard output says how it ended:
``killed``, or its exit status. Started anew each time, most runs would be killed while they import; and by the clock on
the wall, a busy machine would kill them sooner.
"""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback

import psutil

from roadscan.cli import main
from roadscan.ingest.reading.format import log_formats
from roadscan.run.stage import stages
from roadscan.tiles.product import products


def run_for(seconds: float) -> str:
    """How a run ended that had so much processor time."""
    child = os.fork()
    if child == 0:
        _run()
    used = psutil.Process(child)
    while sum(used.cpu_times()[:2]) < seconds:
        if (status := _status_of(child, os.WNOHANG)) is not None:
            return status
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    return _status_of(child, 0) or "killed"


def _run() -> None:
    status = 1
    sys.stdout = sys.stderr  # how it ended is all that whoever reads standard output expects
    try:
        main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
    except Exception:  # noqa: BLE001 — it ends in words, whatever it is
        traceback.print_exc()  # `os._exit` below would end the fork before Python shows it
    finally:
        sys.stderr.flush()
        os._exit(status)


def _status_of(child: int, options: int) -> str | None:
    done, status = os.waitpid(child, options)
    if not done:
        return None
    return "killed" if os.WIFSIGNALED(status) else str(os.WEXITSTATUS(status))


if __name__ == "__main__":
    assert stages() and log_formats() and products()
    for line in sys.stdin:
        sys.stdout.write(f"{run_for(float(line))}\n")
        sys.stdout.flush()
