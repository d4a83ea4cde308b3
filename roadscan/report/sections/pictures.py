"""Report section on pictures as measurements: tie points, residuals of each camera, control, worst pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import pyarrow as pa

from roadscan.adjust.tasks.outcome import FOLDER, PICTURES
from roadscan.pictures.ties.stage import MASKS
from roadscan.pictures.ties.tracks import ALL, TRACKS
from roadscan.report.blocks import Block, Paragraph, Picture, Table
from roadscan.report.section import Material, Section
from roadscan.run.session import Session
from roadscan.store.manifest import recorded_table

_WORST: Final = 8  # Pictures that are listed.
_FEWEST: Final = 10  # Measurements of a picture that is compared.


class Pictures(Section):
    """What pictures measured, and how well they fit."""

    name = "pictures"
    title = "Pictures: tie points and control"
    position = 310

    def blocks(self, material: Material) -> Iterator[Block]:
        """Yield a row for each camera, residual maps, the pictures that fit worst, and control points."""
        session = material.session
        rows = _table(session, "picture_residuals")
        if rows is None:
            return
        yield _cameras(rows)
        tied = session.manifest.get(TRACKS, ALL)
        if tied is not None:
            figures = tied.figures()
            yield Table(
                ("left out at tie points", "number"),
                [(what, f"{figures[word]:,}") for word, what in MASKS.items() if word in figures],
                "What masks left out before the adjustment", "picture_masks",
            )  # fmt: skip
        for record in session.manifest.of(PICTURES).values():
            if record.path.startswith(f"{FOLDER}/camera-") and session.store.exists(record.path):
                yield Picture(material.picture(record.path), "Residuals of tie points, before and after", 170.0)
        depths = _table(session, "depth_residuals")
        if depths is not None and depths.num_rows:
            yield _depths(depths)
        edges = _table(session, "edge_boresights")
        if edges is not None and edges.num_rows:
            yield _edges(edges.to_pylist())
        yield _worst(rows)
        control = _table(session, "picture_control")
        if control is not None:
            yield _control(control.to_pylist())


def _table(session: Session, name: str) -> pa.Table | None:
    records = [record for record in session.manifest.of(name).values() if record.path]
    return recorded_table(session.store, records[0]) if records else None


def _of(rows: pa.Table, by: list[str]) -> list[dict[str, Any]]:
    """Return counts, sums and squares of the measurements of tie points that count, by run, camera or picture."""
    used = rows.filter(pa.compute.and_(pa.compute.is_valid(rows["track"]), pa.compute.greater(rows["weight"], 0.0)))
    columns: dict[str, Any] = {name: used[name] for name in by}
    for word in ("before", "after"):
        u, v = used[f"{word}_u_px"], used[f"{word}_v_px"]
        columns[word] = pa.compute.add(pa.compute.multiply(u, u), pa.compute.multiply(v, v))
    grouped = pa.table(columns).group_by(by).aggregate([("before", "mean"), ("after", "mean"), ("after", "count")])
    found: list[dict[str, Any]] = grouped.sort_by([(name, "ascending") for name in by]).to_pylist()
    return found


def _cameras(rows: pa.Table) -> Table:
    listed = [
        (
            one["run"], one["sensor"], f"{one['after_count']:,}", f"{(one['before_mean'] / 2) ** 0.5:.2f}",
            f"{(one['after_mean'] / 2) ** 0.5:.3f}",
        )
        for one in _of(rows, ["run", "sensor"])
    ]  # fmt: skip
    return Table(
        ("run", "camera", "measurements", "RMS before (px)", "RMS after (px)"), listed,
        "Tie points that count; the RMS is that of one coordinate", "picture_residuals",
    )  # fmt: skip


def _depths(rows: pa.Table) -> Table:
    used = rows.filter(pa.compute.greater(rows["weight"], 0.0))
    by = ["run", "sensor", "lidar"]
    sizes = {word: pa.compute.abs(used[f"{word}_m"]) for word in ("before", "after")}
    grouped = pa.table({name: used[name] for name in by} | sizes).group_by(by)
    told = [("before", "approximate_median"), ("after", "approximate_median"), ("after", "count")]
    found = grouped.aggregate(told)
    listed = [
        (
            one["run"], one["sensor"], one["lidar"], f"{one['after_count']:,}",
            f"{1e3 * one['before_approximate_median']:.0f}", f"{1e3 * one['after_approximate_median']:.0f}",
        )
        for one in found.sort_by([(name, "ascending") for name in by]).to_pylist()
    ]  # fmt: skip
    return Table(
        ("run", "camera", "lidar", "depths that count", "median before (mm)", "median after (mm)"), listed,
        f"Tie points on surfaces of the lidar: {rows.num_rows - used.num_rows:,} more do not count", "depths",
    )  # fmt: skip


def _edges(rows: list[dict[str, Any]]) -> Table:
    listed = [
        (
            one["sensor"], one["lidar"], f"{one['pictures']:,}", f"{one['edges']:,}",
            one["why_not"] or ", ".join(
                f"{axis} {one[f'{axis}_deg']:+.3f}° (σ {one[f'sigma_{axis}_deg']:.3f}°)"
                for axis in ("roll", "pitch", "heading")
            ),
        )
        for one in rows
    ]  # fmt: skip
    return Table(
        ("camera", "lidar", "pictures", "range edges", "boresight that they show, or why not"), listed,
        "Range edges of lidars at edges of pictures: turn from the stated boresight", "edge_boresights",
    )  # fmt: skip


def _worst(rows: pa.Table) -> Block:
    every = [one for one in _of(rows, ["run", "sensor", "file"]) if one["after_count"] >= _FEWEST]
    every.sort(key=lambda one: (-one["after_mean"], one["file"]))
    listed = [
        (one["run"], one["sensor"], one["file"], f"{one['after_count']:,}", f"{(one['after_mean'] / 2) ** 0.5:.3f}")
        for one in every[:_WORST]
    ]
    if not listed:
        return Paragraph(f"No picture has {_FEWEST} measurements that count.", is_warning=True)
    return Table(
        ("run", "camera", "picture", "measurements", "RMS after (px)"), listed, "Pictures that fit worst",
        "worst_pictures",
    )  # fmt: skip


def _control(rows: list[dict[str, Any]]) -> Table:
    return Table(
        ("point", "role", "pictures", "before (mm): north, east, down", "after (mm): north, east, down"),
        [(r["point"], r["role"], str(r["pictures"]), _mm(r, "before"), _mm(r, "after")) for r in rows],
        "Control points in pictures: where their rays meet, minus survey; check points take no part", "picture_control",
    )  # fmt: skip


def _mm(row: dict[str, Any], word: str) -> str:
    values = [row[f"{word}_{axis}_m"] for axis in ("north", "east", "down")]
    return ", ".join("–" if value is None else f"{1e3 * value:+.0f}" for value in values)
