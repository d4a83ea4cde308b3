"""What a server answers besides documents: measuring in pictures, and where people may edit, edits and control."""

from __future__ import annotations

from pathlib import Path

from roadscan.run.session import Session
from roadscan.site.edit_door import EditDoor
from roadscan.site.live import LiveSite
from roadscan.site.measuring_door import MeasuringDoor
from roadscan.site.parts.edits import POST
from roadscan.site.parts.measuring import CONTROL, MEASURE, has_control
from roadscan.site.server import Door


def doors_of(site: LiveSite, survey_file: str | Path, *, edited: bool) -> dict[str, Door]:
    """Return the doors of a survey's page by their paths; those that write only where people may edit.

    Raises
    ------
    ConfigError
        where people may edit, and there is neither an inventory nor control that pictures may see.
    """
    measuring = MeasuringDoor(site, survey_file)
    doors = {MEASURE: Door(measuring.measure, writes=False)}
    if edited:
        if not has_control(site.material):
            site.material.check_edits()
        doors[POST] = Door(EditDoor(lambda: Session.open(survey_file)).take, writes=True)
        doors[CONTROL] = Door(measuring.control, writes=True)
    return doors
