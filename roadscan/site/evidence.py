"""Evidence for a feature: the pictures that see it, and the passes with their logs."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from roadscan.core.errors import RoadscanError
from roadscan.site.material import Material
from roadscan.site.site_pictures import cut_out_records, cut_out_url, picture_urls

Told = dict[str, Any]


def of_pictures(material: Material, row: Mapping[str, Any]) -> Iterator[Told]:
    """Yield the cut-out of an asset, and the pictures of its column `pictures`, best first."""
    name = row.get("cut_out")
    cut = cut_out_records(material).get(str(name)) if name else None
    if cut is not None:
        yield {"title": "cut-out", "kind": "cut_out", "url": cut_out_url(cut)}
    pictures = _pictures_named(row.get("pictures"))
    urls = picture_urls(material) if pictures else {}
    for one in pictures:
        names = str(one.get("run")), str(one.get("camera")), str(one.get("file"))
        url, distance = urls.get(names), one.get("distance_m")
        away = f", {distance:g} m away" if isinstance(distance, int | float) else ""
        told = {"title": f"picture {' '.join(names)}{away}", "kind": "picture"}
        yield told | ({} if url is None else {"url": url})


def _pictures_named(text: Any) -> list[Mapping[str, Any]]:
    try:
        named = json.loads(text) if isinstance(text, str) else []
    except ValueError:
        return []
    return [one for one in named if isinstance(one, dict)] if isinstance(named, list) else []


def of_passes(material: Material, epochs_gps_ns: Iterable[Any], run: str | None = None) -> Iterator[Told]:
    """Yield the passes at some epochs, of one run where it is named."""
    wanted = [one for one in epochs_gps_ns if isinstance(one, int)]
    for own in material.plan.passes if wanted else ():
        if run in (None, own.run) and any(own.start_gps_ns <= one < own.end_gps_ns for one in wanted):
            yield of_pass(material, own.pass_id)


def of_pass(material: Material, number: int) -> Told:
    """Return a pass by its number; its row in the layer of passes names its logs."""
    run = next((one.run for one in material.plan.passes if one.pass_id == number), None)
    title = f"pass {number}" + (f" of {run}" if run else "")
    return {"title": title, "kind": "row", "layer": "passes", "row": str(number)}


def of_run(material: Material, run: str) -> Iterator[Told]:
    """Return the logs of a run."""
    for record in _records(material):
        if record.run == run:
            yield {"title": f"{record.sensor}: {record.path} ({record.format}, {record.rows:,} rows)", "kind": "log"}


@functools.lru_cache(maxsize=2)
def _records(material: Material) -> tuple[Any, ...]:
    try:
        return tuple(material.plan.records)
    except RoadscanError:
        return ()
