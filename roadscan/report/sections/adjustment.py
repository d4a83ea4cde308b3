"""Report section on the adjustment: its corrections, the agreement of passes and control, and each target as seen."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any, Final

from PIL import Image

from roadscan.adjust.quality import ASPRS_CHECK_POINTS, NSSDA_CHECK_POINTS
from roadscan.adjust.tasks.outcome import FOLDER, PICTURES, known_findings, known_lines
from roadscan.core.counted import counted
from roadscan.core.gpstime import NS_PER_S, iso_from_gps_ns
from roadscan.report.blocks import Block, Paragraph, Picture, Table
from roadscan.report.section import Material, Section
from roadscan.run.session import Session
from roadscan.store.manifest import recorded_rows

_MOST_TARGETS: Final = 24  # pictures of targets
_TARGET_MM: Final = 25.0  # width of a target's picture

_FEWEST_RMSE: Final = 3
"""Least residuals for an RMSE with a useful σ."""
_LARGER: Final = 1.5
"""Ratio of differences of ties to their σ that is reported; chance alone does not reach it with ten ties."""
_FEWEST_TIES: Final = 10  # least ties for that comparison
_ODD_SIGMAS: Final = 3.0
"""Residuals of more σ than this are listed."""
_NAMES: Final = {"check": "check points", "left_out": "each GCP left out", "datum": "all GCPs against the poses"}

Rows = Sequence[dict[str, Any]]


class Adjustment(Section):
    """Corrections of the poses, and their accuracy."""

    name = "adjustment"
    title = "Adjustment: seams and control"
    position = 300

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield figures in words, faults, accuracy, seams before and after, control points, targets."""
        session = material.session
        manifest = session.manifest
        for one in known_findings(manifest):
            yield Paragraph(one.text, is_warning=True)
        for line in known_lines(manifest):
            yield Paragraph(line)
        yield from _pictures(material, [f"{FOLDER}/adjustment.png"], "Control residuals on the map and as histograms")
        seams = "Two passes at the place where they differed most, and at a typical one, before and after"
        yield from _pictures(material, [f"{FOLDER}/seams.png"], seams)
        yield from _accuracy(_rows(session, "absolute_accuracy"))
        yield from _by_distance(_rows(session, "accuracy_by_distance"))
        yield from agreement(_rows(session, "tie_residuals"))
        yield from _seams(_rows(session, "relative_accuracy"))
        yield from _control(_rows(session, "control_residuals"))
        targets = sorted(r.path for r in manifest.of(PICTURES).values() if "/targets/" in r.path)
        if targets:
            yield Paragraph("Targets as the passes saw them: point, run and status, and when:")
        for path in targets[:_MOST_TARGETS]:
            yield from _pictures(material, [path], _of_target(material, path), _TARGET_MM)


def _rows(session: Session, table: str) -> Rows:
    return recorded_rows(session.store, session.manifest.of(table).values())


def _pictures(material: Material, paths: Sequence[str], caption: str, width_mm: float = 170.0) -> Iterator[Picture]:
    for path in paths:
        if material.session.store.exists(path):
            yield Picture(material.picture(path), caption, width_mm)


def _of_target(material: Material, path: str) -> str:
    """Return point, run and status, which are the picture's title, and the time, whose GPS second ends its name."""
    title = Image.open(io.BytesIO(material.picture(path))).info.get("Title", "")
    gps_s = int(path.removesuffix(".png").rsplit("-", 1)[-1])
    return f"{title}, {iso_from_gps_ns(gps_s * NS_PER_S)[:19].replace('T', ' ')}"


def _accuracy(rows: Rows) -> Iterator[Table | Paragraph]:
    if not rows:
        return
    is_statement = any(r["count"] >= NSSDA_CHECK_POINTS for r in rows if r["points"] != "datum")
    yield Table(
        ("points", "component", "poses", "count", "mean", "mean absolute", "RMSE",
         *(["95 % (NSSDA)"] if is_statement else []), "largest"),
        [
            (
                _NAMES[r["points"]], r["component"], r["poses"], f"{r['count']:,}", _mm(r["mean_m"]),
                _mm(r["mean_absolute_m"]), _rmse(r["rmse_m"], r["count"] if r["points"] != "datum" else 0),
                *([_mm(r["nssda_95_m"] if r["count"] >= NSSDA_CHECK_POINTS else None)] if is_statement else []),
                _mm(r["largest_m"]),
            )
            for r in sorted(rows, key=lambda r: (r["points"], r["component"], r["poses"] != "recorded"))
        ],
        "Absolute accuracy in mm: surface minus survey; an RMSE with the 1 σ that it has itself", "absolute_accuracy",
    )  # fmt: skip
    most = max((r["count"] for r in rows if r["points"] == "check"), default=0)
    if most < ASPRS_CHECK_POINTS:
        lacks = f"NSSDA takes {NSSDA_CHECK_POINTS} at least, ASPRS (2023) {ASPRS_CHECK_POINTS}"
        said = "there are no check points" if not most else f"{counted(most, 'check point')} of a component at most"
        yield Paragraph(f"This is no statement of accuracy after a standard: {said}; {lacks}.")


def _rmse(value_m: float, count: int) -> str:
    """Return the RMSE in mm with its σ: that of n normal errors is RMSE / √(2n)."""
    return _mm(value_m) + (f" ± {1e3 * value_m / (2 * count) ** 0.5:.2f}" if count >= _FEWEST_RMSE else "")


def _by_distance(rows: Rows) -> Iterator[Table]:
    if rows:
        yield Table(
            ("points", "nearest control", "mean distance", "count", "mean", "mean absolute", "RMSE"),
            [
                (
                    _NAMES[r["points"]],
                    f"from {r['from_m']:,.0f} m" + ("" if r["to_m"] is None else f" to {r['to_m']:,.0f} m"),
                    f"{r['mean_distance_m']:,.0f} m", f"{r['count']:,}",
                    _mm(r["mean_m"]), _mm(r["mean_absolute_m"]), _rmse(r["rmse_m"], r["count"]),
                )
                for r in rows
            ],
            "Error of heights by distance along the road to the nearest ground control, in mm", "accuracy_by_distance",
        )  # fmt: skip


def agreement(rows: Rows) -> Iterator[Table | Paragraph]:
    """Yield the agreement of the passes over all used ties, with the σ of these."""
    kinds: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        if row["accepted"]:
            kinds[row["kind"].replace("_", " ")].append(row)
    if not kinds:
        return
    figures = {
        kind: [_rms([row[name] for row in own]) for name in ("before_m", "after_m", "sigma_m")]
        for kind, own in sorted(kinds.items())
    }
    yield Table(
        ("ties", "count", "RMS before", "RMS after", "σ of the ties"),
        [(kind, f"{len(kinds[kind]):,}", *(_mm(value) for value in own)) for kind, own in figures.items()],
        "Pass against pass, in mm", "tie_residuals",
    )  # fmt: skip
    for kind, (_, after, sigma) in figures.items():
        if after > _ODD_SIGMAS * sigma > 0.0:
            yield Paragraph(
                f"After the adjustment the passes still differ by {_mm(after)} mm in the {kind}s, {after / sigma:.0f} "
                f"times their σ of {_mm(sigma)} mm: this σ is that of finding the same surface or picture twice, and "
                "the poses, the clocks or the mountings err by more.",
                is_warning=True,
            )
        elif after > _LARGER * sigma > 0.0 and len(kinds[kind]) >= _FEWEST_TIES:
            yield Paragraph(
                f"After the adjustment the {kind}s differ by {_mm(after)} mm, {after / sigma:.1f} times their σ of "
                f"{_mm(sigma)} mm: this σ is too small, or the poses, the clocks or the mountings err."
            )


def _rms(values: Sequence[float]) -> float:
    return float((sum(value**2 for value in values) / len(values)) ** 0.5)


def _seams(rows: Rows) -> Iterator[Table]:
    """Yield the agreement of the passes by section of 100 m."""
    if not rows:
        return
    yield Table(
        ("run", "ties", "from station (m)", "count", "RMS before", "RMS after"),
        [
            (
                r["run"], r["kind"].replace("_", " "), f"{r['first_station_m']:,.0f}", f"{r['count']:,}",
                _mm(r["rms_before_m"]), _mm(r["rms_after_m"]),
            )
            for r in rows
        ],
        "Pass against pass by 100 m, in mm", "relative_accuracy",
    )  # fmt: skip


def _control(rows: Rows) -> Iterator[Table | Paragraph]:
    if rows:
        yield Table(
            ("point", "role", "run", "status", "height before", "height after", "σ", "after / σ", "weight", "remark"),
            [
                (
                    r["name"], r["role"], r["run"], r["status"], _mm(_negative(r["height_before_m"])),
                    _mm(_negative(r["height_after_m"])), _mm(r["sigma_height_m"]), _ratio(r),
                    "–" if r["weight_height"] is None else f"{r['weight_height']:.2f}", r["why_not"],
                )
                for r in rows
            ],
            "Control and check points: height of the surface minus survey, in mm; σ is that of the point's survey and "
            "of its measurement by the pass (the table has survey minus surface)",
            "control_residuals",
        )  # fmt: skip
        odd = [r for r in rows if abs(_sigmas(r) or 0.0) > _ODD_SIGMAS]
        if odd:
            named = ", ".join(f"{r['name']} in {r['run']} ({_ratio(r)} σ)" for r in odd)
            yield Paragraph(
                f"A height after the adjustment contradicts its σ at {named}: the point, or the σ that is stated for "
                "it or for the poses, is wrong.",
                is_warning=True,
            )


def _sigmas(row: dict[str, Any]) -> float | None:
    """Return how many of its σ the surface is too high after the adjustment."""
    after, sigma = row["height_after_m"], row["sigma_height_m"]
    return None if after is None or not sigma else float(-after / sigma)


def _negative(value_m: float | None) -> float | None:
    return None if value_m is None else -value_m


def _ratio(row: dict[str, Any]) -> str:
    sigmas = _sigmas(row)
    return "–" if sigmas is None else f"{sigmas:.1f}"


def _mm(value_m: float | None) -> str:
    return "–" if value_m is None else f"{1e3 * value_m:.2f}"
