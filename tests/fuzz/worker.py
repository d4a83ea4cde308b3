"""Reads damaged files of one sample in a process of its own, and tells what came of each, a line a file.

``python -m tests.fuzz.worker SAMPLE SEED FIRST END FOLDER``
"""

from __future__ import annotations

import dataclasses
import faulthandler
import json
import sys
from pathlib import Path

from tests.fuzz.harness import SLOWEST_S, Fuzzer
from tests.fuzz.samples import all_samples


def main(name: str, seed: str, first: str, end: str, folder: str) -> None:
    faulthandler.enable()
    sample = next(s for s in all_samples() if s.name == name)
    fuzzer = Fuzzer(sample, Path(folder), int(seed))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for number in range(int(first), int(end)):
        faulthandler.dump_traceback_later(2 * SLOWEST_S, exit=True)  # where a library hangs, no alarm is heard
        sys.stdout.write(json.dumps(dataclasses.asdict(fuzzer.run(number))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
