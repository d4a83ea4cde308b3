"""Adapts the report to a site around or beside it: its pictures of places become links to the page."""

from __future__ import annotations

from pathlib import Path
from typing import Final

REPORT: Final = "report"
"""Product of the report's record."""
_PLACE: Final = b'<a data-place="'
"""The report's mark of a picture of a place; the part of the address after the page's name follows."""


def linked_report(content: bytes, site: str | None) -> bytes:
    """Return the report with its pictures of places as links into a site.

    Parameters
    ----------
    content : the page as it was kept.
    site : way from the page to the folder of the site, empty or ending with ``/``; None where there is none.
    """
    return content if site is None else content.replace(_PLACE, f'<a href="{site}index.html'.encode())


def site_beside(page: Path) -> str | None:
    """Return the path from a page to the site in its folder, or in `site` beside it; None where there is none."""
    for folder in ("", "site/"):
        if (page.parent / folder / "survey.json").is_file():
            return folder
    return None
