"""Report section on the findings of the witnesses."""

from __future__ import annotations

from collections.abc import Iterator

from roadscan.report.blocks import Block, Paragraph, Table
from roadscan.report.section import Material, Section


class Doubts(Section):
    """Inputs that were left out, and doubtful ones."""

    name = "doubts"
    title = "What was left out, and what is doubtful"
    position = 20

    def blocks(self, material: Material) -> Iterator[Block]:
        """A row for each finding."""
        found = material.summary.findings
        if not found:
            yield Paragraph("No witness of the inputs contradicts them.")
            return
        rows = [(one.subject, one.text, f"{one.left_out:,}" if one.left_out else "–") for one in found]
        yield Table(("input", "what was found", "left out"), rows, numbers=False)
