"""The report as a self-contained HTML page: no script, no font, no external address."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.compute as pc
from jinja2 import Environment, StrictUndefined

from roadscan import __version__
from roadscan.core.errors import RoadscanError
from roadscan.inventory.of_survey import commits_of
from roadscan.navigation.tasks.recorded_pictures import keep_file
from roadscan.report.blocks import Paragraph, Part
from roadscan.report.section import Material, Section, sections
from roadscan.run.keys import code_digest, key_of
from roadscan.run.session import Session
from roadscan.site.report_copy import REPORT
from roadscan.store.digest import bytes_digest
from roadscan.store.small_tables import REPAIR_HINT, small_path

PATH: Final = "report/report.html"
"""Its path, relative to the survey's root."""
_NOT_WHOLE: Final = "not whole"
"""Key of a report without some section: the next run makes it again, whatever kept the section from being made."""
_NOT_SHOWN: Final = ("manifest/log_copies/", "manifest/sources")
"""Records of which the report shows nothing: copies, and when raw files were read last."""


def report_page(session: Session) -> str:
    """Return the report of a survey as HTML; the same store gives the same text.

    A section whose tables are damaged says so in its place; the others stand.
    """
    return _made(session)[0]


def _made(session: Session) -> tuple[str, list[str]]:
    """Return the report, and what it lacks because that could not be made, in words."""
    config, failed = session.survey.config, list[str]()
    material = Material(session)
    parts = [part for part in (_part(section, material, failed) for section in sections()) if part.blocks]
    failed += [f"what is damaged: {words}" for words in material.faults]
    lead = (
        f"Report of the survey {config.id}. Lengths are in metres unless a unit is named; σ is one standard "
        "deviation; times are UTC."
    )
    made_of = "the records and tables of the survey's store"
    return html_page(f"{config.id}: report of the survey", config.title or config.id, lead, parts, made_of), failed


def html_page(title: str, heading: str, lead: str, parts: Sequence[Part], made_of: str) -> str:
    """Return parts as a self-contained page.

    title : of the browser's window; heading, lead : what stands first; made_of : what the page follows from, in words.
    """
    template = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(files(__package__).joinpath("page.html").read_text(encoding="utf-8"))
    footer = f"Made by roadscan {__version__} from {made_of}."
    return template.render(title=title, heading=heading, lead=lead, parts=parts, footer=footer)


def keep_report(session: Session) -> str:
    """Write the report if what it is made of changed; return its path relative to the survey's root."""
    manifest, key = session.manifest, _key(session)
    if not manifest.is_current(REPORT, REPORT, key):
        page, failed = _made(session)
        for words in failed:
            session.note(f"the report lacks {words}")

        def write(file: Path) -> None:
            file.write_bytes(page.encode("utf-8"))

        keep_file(session.store, manifest, (REPORT, REPORT), _NOT_WHOLE if failed else key, PATH, write)
    return PATH


def _key(session: Session) -> str:
    """Return the key of the report: a hash of all records, small tables and settings, and of its sections' code."""
    store, survey = session.store, session.survey
    outputs = session.manifest.table()
    outputs = outputs.filter(pc.not_equal(outputs.column("product"), REPORT))
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, outputs.schema) as stream:
        stream.write_table(outputs.combine_chunks())
    read = [path for path in store.files("manifest", ".json") if not path.startswith(_NOT_SHOWN)]
    read += [path for path in map(small_path, REPAIR_HINT) if store.exists(path)]
    return key_of(
        __version__,
        code_digest(f"{__name__}:report_page", *sorted({type(section).__module__ for section in sections()})),
        bytes_digest(sink.getvalue()),
        [(path, bytes_digest(store.read_bytes(path))) for path in read],
        survey.config.model_dump_json(exclude={"rig"}),
        survey.rig.model_dump_json(),
        commits_of(session),
    )


def _part(section: Section, material: Material, failed: list[str]) -> Part:
    """Return a section of the report; where it cannot be made, `failed` gets its title and why."""
    try:
        return Part(section.name, section.title, tuple(section.blocks(material)))
    except RoadscanError as error:
        failed.append(f"a section: {section.title}: {error}")
        told = Paragraph(f"This section could not be made: {error}", is_warning=True)
        return Part(section.name, section.title, (told,))
