"""Post-processes one rover's GNSS observations outside a survey: a solution file, its picture, its figures."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pyarrow as pa

from roadscan.core.extras import can_draw
from roadscan.core.witness import Finding
from roadscan.formats.motion.ppk import Ppk, PpkOptions, processed
from roadscan.ingest.reading.format import LogSource, Rows
from roadscan.navigation.ppk_picture import COLUMNS, PpkPicture, draw_ppk

_POSITION: Final = ("x_world_m", "y_world_m", "z_world_m")


@dataclass(frozen=True)
class PpkResult:
    """What post-processing gave."""

    files: tuple[Path, ...]
    """Solution, and its picture where Matplotlib is installed."""
    figures: dict[str, Any]
    """Counts and distances, as in the record of a log in a store."""
    findings: tuple[Finding, ...]
    last_world_m: tuple[float, ...]
    """Geocentric position (m) of the last epoch, in the base's datum; in static mode it uses all epochs."""


def post_process(rover: Path, options: PpkOptions, out: Path) -> PpkResult:
    """Write the solution of a rover's observations (RTKLIB's .pos) and its picture beside it.

    Raises
    ------
    RoadscanError
        where something is not stated, contradicts its witness, or RTKLIB is not installed.
    """
    source, reader = LogSource(path=rover.resolve(), options=options), Ppk()
    header = reader.header(source)
    batches, findings = [], []
    with tempfile.TemporaryDirectory(prefix="roadscan-ppk-") as scratch:
        for item in processed(source, header, Path(scratch)):
            if isinstance(item, Rows):
                batches.append(item.batch)
            elif isinstance(item, Finding):
                findings.append(item)
        solution = (Path(scratch) / "solution.pos").read_text("utf-8")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(_stated(rover, header.attributes["base"]) + solution, "utf-8", newline="\n")
    rows, figures = pa.Table.from_batches(batches), header.attributes["ppk"]
    files = [out]
    if can_draw():
        files.append(out.with_suffix(".png"))
        draw_ppk(files[-1], PpkPicture.of(rover.name, rows.select(COLUMNS), figures))
    last = rows.sort_by("epoch_gps_ns").slice(rows.num_rows - 1)
    return PpkResult(tuple(files), figures, tuple(findings), tuple(last.column(name)[0].as_py() for name in _POSITION))


def _stated(rover: Path, base: Mapping[str, Any]) -> str:
    """Return comments that name the datum, which RTKLIB's header calls WGS84 whatever it is."""
    epoch = f", epoch {base['epoch']:g}" if "epoch" in base else ""
    return f"% rover     : {rover.name}\n% datum     : that of the base's position, {base['crs']}{epoch}\n"
