"""What a server answers besides documents: measuring in pictures, and where people may edit, edits and control."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field

from roadscan.core.errors import ConfigError
from roadscan.core.strict import Strict
from roadscan.core.survey import Survey
from roadscan.georeference.plan.plan import SurveyPlan, poses_plan_of
from roadscan.inventory.homes.page_edits import PageDocument
from roadscan.inventory.of_survey import page_document, truth_of
from roadscan.measuring.measure import Measured, length_of, measure, meet, picture_number, posed_pictures
from roadscan.measuring.words import geojson_of, place_rows
from roadscan.pictures.points import FILE, ClickedPoints, control_rows, measured_points
from roadscan.run.session import Session
from roadscan.site.live import LiveSite
from roadscan.site.parts.edits import CONTROL, MEASURE, POST, has_control
from roadscan.site.server import Door
from roadscan.site.where import pictures_of_place


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


class EditDoor:
    """Applies documents of edits, one after another."""

    def __init__(self, open_session: Callable[[], Session]) -> None:
        self._open = open_session
        self._alone = threading.Lock()

    def take(self, content: bytes, who: str = "") -> dict[str, Any]:
        """Apply all sound edits of a document; the answer has the result of each, in the order of the document.

        who : their author, as a proxy told it; "" where the document itself says who edited.

        Raises
        ------
        HomeError
            where it is no such document, or made of another inventory.
        """
        with self._alone:
            session = self._open()
            document: PageDocument = page_document(session, "the page", content).by(who)
            pulled, outcomes = truth_of(session).pull_page(document, sound=True)
        results = [one._asdict() for one in outcomes]
        return {"commit": pulled.commit, "edits": results, "conflicts": pulled.conflicts}


_MOST_PIXELS: Final = 1000  # Corners of a line.
_MOST_PICTURES: Final = 40  # Pictures of a control point that are shown, the finest first.

Pixel = tuple[float, float]


class MeasureRequest(Strict):
    """Pixels of one picture, whose rays meet the ground, or one pixel in each of two, whose rays meet."""

    pictures: tuple[str, ...] = Field(min_length=1, max_length=2)
    """RUN/CAMERA/FILE of each."""
    pixels: tuple[Pixel, ...] = Field(min_length=1, max_length=_MOST_PIXELS)
    """From the centre of the upper left one."""


class ControlRequest(Strict):
    """What a window asks about control points."""

    action: Literal["list", "show", "put"]
    """All points; the pictures of one; a measurement that is written or removed."""
    point: str = ""
    """Name of the point."""
    picture: str = ""
    """RUN/CAMERA/FILE of the picture, for `put`."""
    pixel: Pixel | None = None
    """The measurement; None removes it."""
    before: Pixel | None = None
    """The measurement that the window shows; None for none."""


class MeasuringDoor:
    """Answers a site's page, one request after another, by the poses that the page shows."""

    def __init__(self, site: LiveSite, survey_file: str | Path) -> None:
        self._site, self._survey_file = site, Path(survey_file)
        self._alone = threading.Lock()
        self._of: object = None
        self._session: Session | None = None
        self._clicked = ClickedPoints(site.material.session.survey.folder / FILE)

    def measure(self, content: bytes, _who: str = "") -> dict[str, Any]:
        """Return the places that pixels show, with their σ, as `roadscan where --picture` does.

        Raises
        ------
        ConfigError
            where the request, a picture or a pixel is none, or two rays do not meet.
        """
        asked = MeasureRequest.parse(_values(content))
        with self._alone:
            session = self._opened()
            gap_m = None
            if len(asked.pictures) == 1:
                measured = measure(session, asked.pictures[0], asked.pixels)
            else:
                if len(asked.pixels) != 2:
                    raise ConfigError(f"{len(asked.pixels)} pixels of two pictures", expected="one of each")
                place, gap_m = meet(session, asked.pictures, (asked.pixels[0], asked.pixels[1]))  # type: ignore[arg-type]
                poses, plan = posed_pictures(session), poses_plan_of(session)
                numbers = [picture_number(poses.pictures, name, plan) for name in asked.pictures]
                log = poses.pictures.logs[poses.pictures.log[numbers[0]]]
                assumed = "; ".join(dict.fromkeys(filter(None, (poses.assumed(k) for k in numbers))))
                measured = Measured(log.run, log.sensor, poses.pictures.path(numbers[0]), (place,), assumed)
            kept = [one for one in measured.places if not one.reason]
            length_m, sigma_length_m = length_of(kept) if kept else (None, None)
            return {
                "places": place_rows(measured.places), "assumed": measured.assumed, "gap_m": gap_m,
                "length_m": length_m, "sigma_length_m": sigma_length_m,
                "geojson": geojson_of(measured, poses_plan_of(session).ground.map) if kept else None,
            }  # fmt: skip

    def control(self, content: bytes, _who: str = "") -> dict[str, Any]:
        """Return control points and what is measured of them, after a measurement was written where one is.

        Raises
        ------
        ConfigError
            where the request, its point or its picture is none, or the file holds something else meanwhile.
        """
        asked = ControlRequest.parse(_values(content))
        with self._alone:
            session = self._opened()
            plan = poses_plan_of(session)
            points = control_rows(session.store, plan.records)
            if asked.action != "list" and asked.point not in [row["name"] for row in points]:
                raise ConfigError(f"there is no control point '{asked.point}'", expected="one of the list")
            if asked.action == "put":
                pictures = posed_pictures(session).pictures
                number = picture_number(pictures, asked.picture, plan)
                log = pictures.logs[pictures.log[number]]
                place = log.run, log.sensor, pictures.files[number], asked.point
                self._clicked.put(place, asked.pixel, asked.before)
            answer = {
                "file": self._clicked.file.name, "points": [_shown(row) for row in points],
                "measured": [_measured(row) for row in self._clicked.rows()], "missing": self._missing(),
            }  # fmt: skip
            if asked.action == "show":
                row = next(one for one in points if one["name"] == asked.point)
                answer["pictures"] = self._pictures(session, plan, row)
            return answer

    def _pictures(self, session: Session, plan: SurveyPlan, row: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the pictures that see a control point, the finest first, with the pixel where it is to be expected."""
        level, height = row["sigma_horizontal_m"] or 0.0, row["sigma_height_m"] or 0.0
        place = row["easting_m"], row["northing_m"], row["height_m"]
        seen = pictures_of_place(session, *place, sigma_m=(level, level, height))
        others = [one for one in plan.records if plan.survey.resolve(Path(one.path)) != self._clicked.file.resolve()]
        measured = measured_points(session.store, others, plan.survey.rig).rows.to_pylist()
        elsewhere = {_measured(one)["picture"]: _measured(one) for one in measured if one["point"] == row["name"]}
        names = ("name", "u_px", "v_px", "sigma_u_px", "sigma_v_px", "distance_m", "resolution_m")
        poses = posed_pictures(session)
        found = []
        for one in seen[:_MOST_PICTURES]:
            assumed = poses.assumed(picture_number(poses.pictures, one.name, plan))
            figures = {name: getattr(one, name) for name in names}
            found.append(figures | {"assumed": assumed, "elsewhere": elsewhere.get(one.name)})
        return found

    def _missing(self) -> list[dict[str, str]]:
        """Return what the survey file lacks for the measurements to count, as it stands now."""
        survey = Survey.load(self._survey_file)
        logs = [survey.resolve(Path(log.path)) for run in survey.config.runs for log in run.logs]
        missing = []
        if self._clicked.file.resolve() not in logs:
            log = f'[[runs.logs]]\npath = "{self._clicked.file.name}"\nformat = "picture_points_csv"'
            missing.append({"where": "after the logs of a run (of any: the file names runs and cameras)", "text": log})
        if not survey.has("picture_ties"):
            missing.append(
                {"where": "at the end, so that pictures take part in the adjustment", "text": "[picture_ties]"}
            )
        return missing

    def _opened(self) -> Session:
        """Return the survey as the page shows it."""
        if self._session is None or self._of is not self._site.material:
            self._of, self._session = self._site.material, Session.open(self._survey_file)
            self._session.hear_of_damage()
        return self._session


def _values(content: bytes) -> dict[str, Any]:
    """Return the object that a document holds."""
    try:
        values = json.loads(content)
    except ValueError as error:
        raise ConfigError(f"the request is no JSON: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError("the request is no object")
    return values


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("name", "role", "easting_m", "northing_m", "height_m")}


def _measured(row: dict[str, Any]) -> dict[str, Any]:
    """Return a measurement as the page knows it, its picture as RUN/CAMERA/FILE."""
    picture = f"{row['run']}/{row['sensor']}/{row['picture']}"
    return {"point": row["point"], "picture": picture, "pixel": [row["u_px"], row["v_px"]], "source": row["source"]}
