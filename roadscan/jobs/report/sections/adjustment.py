"""Section of the report: what the adjustment did, how well passes and control agree, and each target as it was seen."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, Final

from roadscan.jobs.adjust.outcome import FOLDER, PICTURES, known_findings, known_lines
from roadscan.jobs.report.blocks import Block, Paragraph, Picture, Table
from roadscan.jobs.report.section import Material, Section
from roadscan.jobs.session import Session
from roadscan.tables.store import Store

_MOST_TARGETS: Final = 24
_TARGET_MM: Final = 25.0

_NAMES: Final = {"check": "check points", "left_out": "each GCP left out"}

Rows = Sequence[dict[str, Any]]


class Adjustment(Section):
    """Corrections of the poses, and what they are worth."""

    name = "adjustment"
    title = "Adjustment: seams and control"
    position = 300

    def blocks(self, material: Material) -> Iterator[Block]:
        """Figures in words, what was found wrong, accuracy, seams before and after, control points, targets."""
        session = material.session
        store, manifest = session.store, session.manifest
        for one in known_findings(manifest):
            yield Paragraph(one.text, is_warning=True)
        for line in known_lines(manifest):
            yield Paragraph(line)
        yield from _pictures(store, [f"{FOLDER}/adjustment.png"], "Control residuals on the map and as histograms")
        seams = "Two passes at the place where they differed most, and at a typical one, before and after"
        yield from _pictures(store, [f"{FOLDER}/seams.png"], seams)
        yield from _accuracy(_rows(session, "absolute_accuracy"))
        yield from _by_distance(_rows(session, "accuracy_by_distance"))
        yield from _seams(_rows(session, "relative_accuracy"))
        yield from _control(_rows(session, "control_residuals"))
        targets = sorted(r.path for r in manifest.of(PICTURES).values() if "/targets/" in r.path)
        if targets:
            yield Paragraph("Targets as the passes saw them; the file's name says point, run and GPS second:")
        yield from _pictures(store, targets[:_MOST_TARGETS], "", _TARGET_MM)


def _rows(session: Session, table: str) -> Rows:
    records = session.manifest.of(table).values()
    return [row for record in records if record.path for row in session.store.read_table(record.path).to_pylist()]


def _pictures(store: Store, paths: Sequence[str], caption: str, width_mm: float = 170.0) -> Iterator[Picture]:
    for path in paths:
        if store.exists(path):
            yield Picture(store.read_bytes(path), caption or path.rsplit("/", 1)[-1].removesuffix(".png"), width_mm)


def _accuracy(rows: Rows) -> Iterator[Table]:
    if rows:
        yield Table(
            ("points", "component", "poses", "count", "mean", "mean absolute", "RMSE", "95 % (NSSDA)", "largest"),
            [
                (
                    _NAMES[r["points"]], r["component"], r["poses"], f"{r['count']:,}",
                    *(_mm(r[name]) for name in ("mean_m", "mean_absolute_m", "rmse_m", "nssda_95_m", "largest_m")),
                )
                for r in rows
            ],
            "Absolute accuracy in mm: surface minus survey", "absolute_accuracy",
        )  # fmt: skip


def _by_distance(rows: Rows) -> Iterator[Table]:
    if rows:
        yield Table(
            ("points", "nearest control", "mean distance", "count", "mean", "mean absolute", "RMSE"),
            [
                (
                    _NAMES[r["points"]],
                    f"from {r['from_m']:,.0f} m" + ("" if r["to_m"] is None else f" to {r['to_m']:,.0f} m"),
                    f"{r['mean_distance_m']:,.0f} m", f"{r['count']:,}",
                    *(_mm(r[name]) for name in ("mean_m", "mean_absolute_m", "rmse_m")),
                )
                for r in rows
            ],
            "Error of heights by distance along the road to the nearest ground control, in mm", "accuracy_by_distance",
        )  # fmt: skip


def _seams(rows: Rows) -> Iterator[Table]:
    """Agreement of the passes over all sections, then by section of 100 m."""
    if not rows:
        return
    sums: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0])
    for row in rows:
        sums[row["kind"]][0] += row["count"]
        sums[row["kind"]][1] += row["count"] * row["rms_before_m"] ** 2
        sums[row["kind"]][2] += row["count"] * row["rms_after_m"] ** 2
    whole = [
        (kind.replace("_", " "), f"{n:,.0f}", _mm((before / n) ** 0.5), _mm((after / n) ** 0.5))
        for kind, (n, before, after) in sorted(sums.items())
        if n
    ]
    yield Table(("ties", "count", "RMS before", "RMS after"), whole, "Pass against pass, in mm")
    yield Table(
        ("run", "ties", "from station (m)", "count", "RMS before", "RMS after"),
        [
            (
                r["run"], r["kind"].replace("_", " "), f"{r['first_station_m']:,.0f}", f"{r['count']:,}",
                _mm(r["rms_before_m"]), _mm(r["rms_after_m"]),
            )
            for r in rows
        ],
        "The same by 100 m, in mm", "relative_accuracy",
    )  # fmt: skip


def _control(rows: Rows) -> Iterator[Table]:
    if rows:
        yield Table(
            ("point", "role", "run", "status", "height before", "height after", "σ", "weight", "why it does not count"),
            [
                (
                    r["name"], r["role"], r["run"], r["status"], _mm(r["height_before_m"]), _mm(r["height_after_m"]),
                    _mm(r["sigma_height_m"]), "–" if r["weight_height"] is None else f"{r['weight_height']:.2f}",
                    r["why_not"],
                )
                for r in rows
            ],
            "Control and check points: surveyed height minus measured, in mm", "control_residuals",
        )  # fmt: skip


def _mm(value_m: float | None) -> str:
    return "–" if value_m is None else f"{1e3 * value_m:.2f}"
