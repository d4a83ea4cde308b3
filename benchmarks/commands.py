"""Commands of roadscan in processes of their own, with what they cost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Command:
    """A command that has ended."""

    output: str
    code: int
    wall_s: float
    cpu_s: float
    """Processor time of the process and of those that it waited for."""
    peak_mb: float
    """Largest resident memory of the process (MB)."""


def command(*arguments: str | Path) -> Command:
    """Run ``roadscan ARGUMENTS`` as an installed program does, with its modules compiled.

    A small process starts it and waits: the system counts the memory of who starts a process as that process's own.
    """
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.NamedTemporaryFile("w+") as out:
        own = [sys.executable, __file__, out.name, sys.executable, "-m", "roadscan", *map(str, arguments)]
        done = subprocess.run(own, check=True, capture_output=True, text=True, env=environment)
        code, wall_s, cpu_s, peak_mb = json.loads(done.stdout)
        return Command(out.read(), code, wall_s, cpu_s, peak_mb)


def main() -> None:
    """Run a command whose output goes to a file, and print what it cost."""
    started = time.perf_counter()
    with Path(sys.argv[1]).open("w") as out:
        process = subprocess.Popen(sys.argv[2:], stdout=out, stderr=out)
        _, status, used = os.wait4(process.pid, 0)
    took = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    print(json.dumps([process.returncode, took, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6]))


if __name__ == "__main__":
    main()
