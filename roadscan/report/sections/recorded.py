"""Report section on the logs that were read, rejected records, and the use of the readings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from roadscan.core.gpstime import utc_from_gps_ns
from roadscan.report.blocks import Block, Table
from roadscan.report.section import Material, Section
from roadscan.store.logs import LogRecord


class Recorded(Section):
    """Logs with their spans, rejected records by reason, readings by result."""

    name = "recorded"
    title = "What was recorded"
    position = 100

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a row per log; rejects by reason; counts of readings."""
        if not material.logs:
            return
        yield Table(
            ("log", "run", "sensor", "format", "first epoch", "last epoch", "rows", "rejected"),
            [_row(r) for r in material.logs],
        )
        reasons: Counter[str] = Counter()
        for record in material.logs:
            reasons.update(record.reject_reasons)
        if reasons:
            rows = [(reason, f"{count:,}") for reason, count in reasons.most_common()]
            yield Table(("reason", "records"), rows, "Records that could not be used", "rejects")
        fates = material.summary.readings
        if fates:
            total = sum(fates.values())
            shares = [(name.replace("_", " "), f"{count:,}", f"{count / total:.2%}") for name, count in fates.items()]
            yield Table(("what became of it", "readings", "share"), shares, "Readings")


def seconds_of(epoch_gps_ns: int) -> str:
    """Return ``2026-05-04 09:30:00`` (UTC) for a GPS epoch."""
    return f"{utc_from_gps_ns(epoch_gps_ns):%Y-%m-%d %H:%M:%S}"


def _row(record: LogRecord) -> tuple[str, ...]:
    spans = [span for table in record.tables if (span := record.span(table)) is not None]
    first = seconds_of(min(s[0] for s in spans)) if spans else "–"
    last = seconds_of(max(s[1] for s in spans)) if spans else "–"
    return (
        record.path, record.run, record.sensor, record.format, first, last,
        f"{record.rows:,}", f"{record.rejected:,}",
    )  # fmt: skip
