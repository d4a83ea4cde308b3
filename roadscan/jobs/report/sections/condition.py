"""Section of the report: the road's condition by section of each lane, with its strip charts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from roadscan.jobs.condition.pictures import PICTURES
from roadscan.jobs.condition.ravelling import RAVELLING_PICTURES
from roadscan.jobs.condition.roughness_regions import REGION_PICTURES
from roadscan.jobs.report.blocks import Block, Picture, Table
from roadscan.jobs.report.section import Material, Section
from roadscan.jobs.session import Session
from roadscan.tables.schema import table_schema

_COLUMNS: Final = (
    ("MRI (m/km)", "mri_m_per_km", 2), ("rut left (mm)", "rut_depth_mean_left_mm", 1),
    ("rut right (mm)", "rut_depth_mean_right_mm", 1), ("cross-slope (%)", "cross_slope_mean_percent", 2),
    ("faulting (mm)", "faulting_mean_mm", 1), ("cracked (%)", "cracked_wheel_path_percent", 1),
    ("MPD (mm)", "mpd_mean_mm", 2), ("ravelled (%)", "ravelled_percent", 1), ("width (m)", "lane_width_m", 2),
    ("measured", "share_measured", 2),
)  # fmt: skip
_MOST_PICTURES: Final = 12


class Condition(Section):
    """Sections of the lanes, as a road authority files them."""

    name = "condition"
    title = "Condition of the lanes"
    position = 500

    def blocks(self, material: Material) -> Iterator[Block]:
        """A row a section; strip charts, cross-sections by lane and kilometre; patches and regions."""
        session = material.session
        rows = _sections(session)
        if not rows:
            return
        head = ("road", "lane", "from (m)", "to (m)", *(title for title, _, _ in _COLUMNS), "remark")
        yield Table(head, [_row(r) for r in rows], "A dash: not measured", "condition_sections")
        for product in (PICTURES, RAVELLING_PICTURES, REGION_PICTURES):
            shown = sorted(r.path for r in session.manifest.of(product).values() if r.path)
            for path in shown[:_MOST_PICTURES]:
                yield Picture(session.store.read_bytes(path), path.rsplit("/", 1)[-1].removesuffix(".png"))


def _sections(session: Session) -> list[dict[str, Any]]:
    location = table_schema("condition_sections").location
    records = [r for r in session.manifest.all() if r.path.startswith(f"{location}/") and r.path.endswith(".parquet")]
    return [row for r in records for row in session.store.read_table(r.path).to_pylist()]


def _row(row: dict[str, Any]) -> tuple[str, ...]:
    figures = tuple("–" if row[name] is None else f"{row[name]:.{digits}f}" for _, name, digits in _COLUMNS)
    span = (f"{row['station_from_m']:,.0f}", f"{row['station_to_m']:,.0f}")
    return (row["name"] or row["road"], row["lane"], *span, *figures, row["reason"] or "")
