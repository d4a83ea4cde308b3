"""The stores into which faults are drawn: a street that was run, its inventory with an edit, and its published site."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from roadscan.demo.demo import SPRING, edit_by_hand, prepare_street


def prepare(folder: Path) -> None:
    """Make them in a folder."""
    survey_file = prepare_street(folder, SPRING, lambda _: None)
    with survey_file.open("a", encoding="utf-8") as file:
        file.write("\n[condition]\n")
    for command in (["run", str(survey_file), "--workers", "0"], [], ["publish", str(survey_file), "--out", "site"]):
        if not command:
            edit_by_hand(survey_file)
            continue
        subprocess.run([sys.executable, "-m", "roadscan", *command], cwd=folder, check=True, env=os.environ.copy())
