"""Puts the built page into the wheel, where there is one: a checkout without Node makes a wheel without it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PageInWheel(BuildHookInterface):
    """Names the page's files to hatchling."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the folder of the page; an editable install finds it in the checkout."""
        built = Path(self.root) / "viewer" / "dist"
        if version != "editable" and (built / "index.html").is_file():
            build_data["force_include"][str(built)] = "roadscan/viewer/dist"
