"""Report section on the road's condition by section of each lane, with its strip charts."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from roadscan.condition.tasks.pictures import CROSS_SECTION, PICTURES, STRIP
from roadscan.condition.tasks.ravelling import RAVELLING_PICTURES
from roadscan.condition.tasks.roughness_regions import REGION_PICTURES
from roadscan.condition.tasks.sections import known_sections
from roadscan.report.blocks import Block, Paragraph, Picture, Table
from roadscan.report.section import Material, Section
from roadscan.run.session import Session
from roadscan.store.manifest import recorded_rows
from roadscan.store.schema import table_schema


class _Column(NamedTuple):
    title: str
    name: str
    digits: int
    sigma: str = ""
    """Column of its standard deviation."""


_SHAPE: Final = (  # columns with their decimals
    _Column("MRI (m/km)", "mri_m_per_km", 2, "sigma_mri_m_per_km"),
    _Column("rut left (mm)", "rut_depth_mean_left_mm", 1, "sigma_rut_depth_mean_mm"),
    _Column("rut right (mm)", "rut_depth_mean_right_mm", 1, "sigma_rut_depth_mean_mm"),
    _Column("cross-slope (%)", "cross_slope_mean_percent", 2, "sigma_cross_slope_mean_percent"),
    _Column("faulting (mm)", "faulting_mean_mm", 1, "sigma_faulting_mean_mm"),
)
_SURFACE: Final = (  # columns with their decimals
    _Column("cracked wheel path (%)", "cracked_wheel_path_percent", 1),
    _Column("MPD (mm)", "mpd_mean_mm", 2, "sigma_mpd_mean_mm"),
    _Column("ravelled (%)", "ravelled_percent", 1, "sigma_ravelled_percent"),
    _Column("lane width (m)", "lane_width_m", 2, "sigma_lane_width_m"),
)
_MOST_PICTURES: Final = 12  # pictures of lanes
_MOST_NAMES: Final = 4  # names of columns that a sentence lists
_REASON: Final = re.compile(r"(?:^|; )((?:[a-z0-9]+_[a-z0-9_]+)(?:, [a-z0-9_]+)*): ")
"""Start of a reason in a section's remark: after the names of the quantities it is about."""
_KINDS: Final = {
    CROSS_SECTION: "cross-sections at its typical and at its deepest rut: the road's height without its tilt, and the "
    "wire from which the depth is measured. Medians over 5 m choose them, so that no pothole is taken for a rut.",
    STRIP: "values of its sections along the station.",
}


class Condition(Section):
    """Sections of the lanes, as a road authority files them."""

    name = "condition"
    title = "Condition of the lanes"
    position = 500

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a row per section; strip charts, cross-sections by lane and kilometre; patches and regions."""
        session = material.session
        rows = _sections(session)
        if not rows:
            if session.survey.has("condition"):
                yield Paragraph("No section of a lane was made.", is_warning=True)
            return
        notes = _Notes()
        yield from _table(rows, _SHAPE, "Evenness and shape", notes)
        yield from _table(rows, _SURFACE, "Surface and width", notes)
        yield from notes.paragraphs()
        yield from _lacking(session)
        yield from _pictures(material)


def _sections(session: Session) -> list[dict[str, Any]]:
    location = table_schema("condition_sections").location
    records = [r for r in session.manifest.all() if r.path.startswith(f"{location}/") and r.path.endswith(".parquet")]
    return recorded_rows(session.store, records)


@dataclass
class _Notes:
    """Distinct remarks by their number."""

    numbers: dict[str, int] = field(default_factory=dict)

    def of(self, row: dict[str, Any], columns: Sequence[_Column]) -> str:
        """Return the numbers of the remarks on quantities in the columns, or on quantities of their kind."""
        found = []
        for names, reason in _reasons(row["reason"] or ""):
            if any(column.name in names for column in columns):
                found.append(self.numbers.setdefault(reason, len(self.numbers) + 1))
        return ", ".join(map(str, sorted(set(found)))) or "–"

    def paragraphs(self) -> Iterator[Paragraph]:
        """Yield the remarks, a line each."""
        yield from (Paragraph(f"Remark {number}: {reason}.") for reason, number in self.numbers.items())


def _reasons(remark: str) -> Iterator[tuple[list[str], str]]:
    """Yield the quantities, and the remark on them."""
    starts = list(_REASON.finditer(remark))
    for start, following in zip(starts, [*starts[1:], None], strict=True):
        end = len(remark) if following is None else following.start()
        yield start[1].split(", "), remark[start.end() : end].strip().rstrip(".")


def _table(rows: Sequence[dict[str, Any]], columns: Sequence[_Column], caption: str, notes: _Notes) -> Iterator[Table]:
    """Yield a table of those columns with a value in any section; none without any."""
    known = [column for column in columns if any(row[column.name] is not None for row in rows)]
    if not known:
        return
    has_share = columns is _SHAPE  # the share is that of profiles and cross-sections
    head = ("lane", "station (m)", *(column.title for column in known), *["measured"][: int(has_share)], "remark")
    lines = [
        (
            f"{row['name'] or row['road']}, {row['lane']}",
            f"{row['station_from_m']:,.0f}–{row['station_to_m']:,.0f}",
            *(_value(row, column) for column in known),
            *[f"{row['share_measured']:.0%}"][: int(has_share)],
            notes.of(row, known),
        )
        for row in rows
    ]
    said = f"{caption}, by section: means ± 1 σ; a dash: not measured in that section"
    yield Table(head, lines, said, "condition_sections")


def _value(row: dict[str, Any], column: _Column) -> str:
    value, sigma = row[column.name], row.get(column.sigma)
    if value is None:
        return "–"
    return f"{value:.{column.digits}f}" + ("" if sigma is None else f" ± {sigma:.{column.digits}f}")


def _lacking(session: Session) -> Iterator[Paragraph]:
    """Yield the columns without a value in any section, with the reason."""
    told = known_sections(session.manifest)
    titles = {column.name: column.title for column in (*_SHAPE, *_SURFACE)}
    for reason, quantities in ({} if told is None else told[1]).items():
        named = [titles[name] for name in quantities if name in titles]
        others = [name for name in quantities if name not in titles]
        named += others[:_MOST_NAMES] if not named else []
        yield Paragraph(f"In no section: {', '.join(named)}. {reason[:1].upper()}{reason[1:]}.")


def _pictures(material: Material) -> Iterator[Picture]:
    for product, caption in (
        (PICTURES, ""),
        (RAVELLING_PICTURES, "Patches of the lane that have lost stones, with their outlines."),
        (
            REGION_PICTURES,
            "Places that are darker than the road around them (red), over the intensity; by section of 10 m.",
        ),
    ):
        shown = sorted((r for r in material.session.manifest.of(product).values() if r.path), key=lambda r: r.path)
        for record in shown[:_MOST_PICTURES]:
            yield Picture(material.picture(record.path), caption or _caption(record.unit))


def _caption(unit: str) -> str:
    """Return the caption of a lane's picture from its name: road_lane_number_kind.png."""
    name = unit.removesuffix(".png")
    kind = next(one for one in _KINDS if name.endswith(f"_{one}"))
    road, lane, number = name.removesuffix(f"_{kind}").rsplit("_", 2)
    return f"{road}, lane {lane}, part {int(number) + 1} of about 1 km: {_KINDS[kind]}"
