"""Makes the page of a finished run as one file, and says where it is and how to see more."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from roadscan.core.errors import RoadscanError
from roadscan.run.session import Session
from roadscan.site.material import Material, Wishes
from roadscan.site.single import write_single
from roadscan.site.web_part import HOW_TO_BUILD, web_folder

PAGE: Final = "page.html"
_FINEST_M: Final = 0.02
"""Finest pixel (m), so that the file takes seconds; finer pixels and the points are for `roadscan view`."""


def page_lines(survey_file: Path) -> list[str]:
    """Return the last lines of a run: the address of its page, or why there is none and how to get it."""
    how = f"roadscan view {survey_file}"
    if web_folder() is None:
        return [f"look at it    {how}", f"              the page is not built yet: {HOW_TO_BUILD}"]
    file = survey_file.parent / PAGE
    try:
        write_single(Material(Session.open(survey_file), Wishes(clouds=False, finest_pixel_m=_FINEST_M)), file)
    except RoadscanError as error:
        return [f"look at it    {how}", f"              its file could not be made: {error}"]
    return [f"look at it    {file.resolve().as_uri()}", f"with points   {how}"]
