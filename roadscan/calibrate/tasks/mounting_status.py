"""Status of calibrated mountings, for `roadscan status` and the report."""

from __future__ import annotations

from roadscan.calibrate.tasks.calibrate import PICTURE
from roadscan.core.errors import DamagedError
from roadscan.store.small_tables import read_small
from roadscan.store.store import Store


def mounting_lines(store: Store) -> list[str]:
    """Return a line for each calibrated mounting; none of a damaged table, which `roadscan verify` reports."""
    try:
        table = read_small(store, "mountings")
    except DamagedError:
        return []
    picture = f"; picture {PICTURE}" if store.exists(PICTURE) else ""
    lines = []
    for row in [] if table is None else table.to_pylist():
        lever = [row[f"sigma_lever_{a}_m"] for a in ("forward", "right", "down")]
        angles = [row[f"sigma_{a}_deg"] for a in ("roll", "pitch", "heading")]
        largest_m, largest_deg = (
            max((v for v in own if v is not None), default=float("nan")) for own in (lever, angles)
        )
        held = f", not determined: {row['not_determined']}" if row["not_determined"] else ""
        lines.append(
            f"mounting of {row['sensor']} (runs {row['run']}): calibrated {row['estimated_at'] or ''} from "
            f"{row['method'] or ''}, σ at most {1e3 * largest_m:.1f} mm and {largest_deg:.3f}°{held}"
            f"{picture if row['calibration'] else ''}"
        )
    return lines
