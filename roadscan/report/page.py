"""The report as a self-contained HTML page: no script, no font, no external address."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Final

from jinja2 import Environment, StrictUndefined

from roadscan import __version__
from roadscan.core.errors import RoadscanError
from roadscan.navigation.tasks.recorded_pictures import keep_file
from roadscan.report.blocks import Paragraph, Part
from roadscan.report.section import Material, Section, sections
from roadscan.run.engine.fingerprint import key_of
from roadscan.run.session import Session
from roadscan.site.report_copy import REPORT

PATH: Final = "report/report.html"
"""Its path, relative to the survey's root."""


def report_page(session: Session) -> str:
    """Return the report of a survey as HTML; the same store gives the same text.

    A section whose tables are damaged says so in its place; the others stand.
    """
    config = session.survey.config
    material = Material(session)
    parts = [part for part in (_part(section, material) for section in sections()) if part.blocks]
    template = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(files(__package__).joinpath("page.html").read_text(encoding="utf-8"))
    return template.render(
        title=f"{config.id}: report of the survey",
        heading=config.title or config.id,
        lead=f"Report of the survey {config.id}. Lengths are in metres unless a unit is named; σ is one standard "
        "deviation; times are UTC.",
        parts=parts,
        footer=f"Made by roadscan {__version__} from the records and tables of the survey's store.",
    )


def keep_report(session: Session) -> str:
    """Write the report if it changed; return its path relative to the survey's root."""
    page = report_page(session).encode("utf-8")
    manifest = session.manifest
    known, key = manifest.get(REPORT, REPORT), key_of(page.hex())
    if known is None or known.key != key or not session.store.exists(PATH):

        def write(file: Path) -> None:
            file.write_bytes(page)

        keep_file(session.store, manifest, (REPORT, REPORT), key, PATH, write)
    return PATH


def _part(section: Section, material: Material) -> Part:
    try:
        return Part(section.name, section.title, tuple(section.blocks(material)))
    except RoadscanError as error:
        told = Paragraph(f"This section could not be made: {error}", is_warning=True)
        return Part(section.name, section.title, (told,))
