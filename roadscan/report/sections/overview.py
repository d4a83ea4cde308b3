"""Report section with a short summary of the survey, and what failed."""

from __future__ import annotations

from collections.abc import Iterator

from roadscan.report.blocks import Block, Paragraph, Table
from roadscan.report.section import Material, Section
from roadscan.report.summary import SurveySummary


class Overview(Section):
    """Figures of the whole survey, and what failed in the last run."""

    name = "overview"
    title = "The survey at a glance"
    position = 10

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a table of figures, and each failure by name."""
        yield Table(("figure", "value"), tuple(_figures(material.summary)))
        failures = material.summary.failures
        if not failures:
            yield Paragraph("Nothing failed in the last run.")
            return
        what = "One unit" if len(failures) == 1 else f"{len(failures):,} units"
        yield Paragraph(f"{what} failed in the last run; the next run tries again.", is_warning=True)
        rows = [(f["stage"], f["unit"], f["reason"]) for f in failures]
        yield Table(("stage", "unit", "reason"), rows, numbers=False)


def _figures(found: SurveySummary) -> Iterator[tuple[str, str]]:
    yield "logs", f"{found.logs.logs:,}"
    yield "rows of the logs", f"{found.logs.rows:,}"
    yield "records rejected", f"{found.logs.rejected:,}"
    readings = sum(found.readings.values())
    if readings:
        kept = found.readings.get("kept", 0)
        yield "readings", f"{readings:,}"
        yield "readings kept", f"{kept:,} ({kept / readings:.1%})"
    if (tiles := found.tiles) is None:
        return
    yield "tiles with readings", f"{tiles.with_readings:,}"
    yield "area measured", f"{tiles.area_m2:,.0f} m²"
    if tiles.overlap_area_m2 is not None and tiles.area_m2:
        yield "area seen by two passes or more", f"{tiles.overlap_area_m2 / tiles.area_m2:.0%}"
    for name, spread in (
        ("σ of the poses, horizontal", tiles.sigma_horizontal_m),
        ("σ of the poses, vertical", tiles.sigma_down_m),
        ("scatter of the heights in a cell", tiles.sigma_cells_m),
    ):
        if spread is not None:
            said = f"{1e3 * spread.median:.2f} mm (median of the tiles)"
            yield name, said if spread.median else "not known: most cells hold one reading"
