"""The whole site: its entry, all its documents, and publishing them as a folder."""

from __future__ import annotations

import functools
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from roadscan.compute.array_types import Float64
from roadscan.core.crs import MapFrame, crs_from_text
from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.run.keys import code_digest, key_of
from roadscan.site.document import Ask, Document, json_document, site_parts
from roadscan.site.material import SHEET_M, Box, Material
from roadscan.site.parts.catalog import from_longitude_latitude, to_longitude_latitude
from roadscan.site.parts.vectors import site_layers
from roadscan.site.report_copy import REPORT, linked_report
from roadscan.site.web_part import web_documents
from roadscan.store.codecs import SOFTWARE
from roadscan.store.digest import checked_json, file_digest, parse_checked
from roadscan.store.holders import beside, put_folder
from roadscan.store.manifest import read_recorded

LAYOUT: Final = 1  # version of the site's layout
ENTRY: Final = "survey.json"
REPORT_PAGE: Final = "report.html"
_LINKED: Final = "roadscan.site.report_copy:linked_report"
KEYS: Final = "keys.json"
"""Documents of the folder, with the key and the digest of each."""


@functools.lru_cache(maxsize=2)
def entry(material: Material) -> Document:
    """Return `survey.json`, from which a page finds everything."""
    context = material.context
    extent_m = material.extent_m
    members: dict[str, Any] = {
        "layout": LAYOUT, "software": SOFTWARE, "id": context.survey_id, "title": context.title or context.survey_id,
        "crs": _crs(context.map), "origin_m": _origin(material), "extent_m": extent_m,
        "height_extent_m": _heights(material), "lon_lat": _longitude_latitude(context.map, extent_m),
        "degrees": degrees_on_map(context.map, extent_m),
        "tile_m": context.grid.size_m, "cell_m": context.grid.cell_m, "sheet_m": SHEET_M,
        "report": REPORT_PAGE if _report(material) is not None else None,
    }  # fmt: skip
    for part in site_parts():
        members |= part.members(material)
    if extent_m is None:
        members["extent_m"] = box = _box_of(members["layers"])
        members["lon_lat"] = _longitude_latitude(context.map, box)
        members["degrees"] = degrees_on_map(context.map, box)
    return json_document(ENTRY, members)


def site_documents(material: Material) -> Iterator[Document]:
    """Yield all documents of the site, in the order in which a page requests them."""
    yield from first_documents(material)
    for part in site_parts():
        yield from part.documents(material)


def first_documents(material: Material) -> Iterator[Document]:
    """Yield the web part, the entry and the report."""
    yield from web_documents()
    yield entry(material)
    record = _report(material)
    if record is not None:

        def write(path: Path, _ask: Ask) -> None:
            path.write_bytes(linked_report(read_recorded(material.store, record), ""))

        yield Document(REPORT_PAGE, key_of(record.digest, code_digest(_LINKED)), write)


@dataclass(frozen=True)
class Published:
    """Result of publishing."""

    folder: Path
    files: int
    made: int
    """Number of files that were written; the others were current."""
    bytes: int
    failures: tuple[tuple[str, str], ...]
    """Documents that could not be made, or not whole, with reasons."""
    left_out: tuple[str, ...] = ()
    """Layers that are missing, with reasons."""
    damaged: tuple[str, ...] = ()
    """Files of the folder that were missing or were not as they had been written; they are made again."""


def publish(material: Material, out: Path, report: Callable[[int, int], None] = lambda _a, _b: None) -> Published:
    """Publish the site as a folder, written under another name and then put in its place.

    What a folder that was published before holds unchanged is taken over.

    Raises
    ------
    ConfigError
        where `out` holds something else than a site.
    """
    known, damaged = known_files(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = beside(out)
    scratch.mkdir()
    try:
        writer = _Writer(scratch, known)
        with material.store.looked():
            documents = list(site_documents(material))
            for done, document in enumerate(documents):
                writer.add(document)
                if done % 50 == 0:
                    report(done, len(documents))
            left_out = (*site_layers(material)[1], *_lost_report(material))
        report(len(documents), len(documents))
        listing = {"layout": LAYOUT, "keys": writer.keys, "digests": writer.digests}
        (scratch / KEYS).write_bytes(checked_json(listing))
        put_folder(scratch, out)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return Published(out, len(writer.keys), writer.made, writer.bytes, tuple(writer.failures), left_out, tuple(damaged))


def known_files(out: Path) -> tuple[dict[str, _Known], list[str]]:
    """Return the whole files of an already published folder by key, and those that are missing or damaged.

    Both are empty where there is no folder, or an empty one. Of a site without digests, which an older version
    published, every file is made again.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return {}, []
    try:
        listing = parse_checked((out / KEYS).read_bytes())
        keys, digests = dict(listing["keys"]), listing.get("digests")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{out} is there already and holds no site, or one whose {KEYS} is damaged ({error})",
            expected="a new or empty folder, or a site to be renewed",
            change="choose another --out, or remove the folder if it was a site: it is made anew",
        ) from error
    if digests is None:
        return {}, []
    whole = {path: (out / path).is_file() and file_digest(out / path) == digests.get(path) for path in keys}
    known = {key: _Known(out / path, digests[path]) for path, key in keys.items() if whole[path]}
    return known, [path for path in sorted(keys) if not whole[path]]


class _Known(NamedTuple):
    """A file of a folder that was published before."""

    path: Path
    digest: str


class _Writer:
    """Writes documents into a folder, once each."""

    def __init__(self, folder: Path, known: dict[str, _Known]) -> None:
        self._folder, self._known = folder, known
        self.keys: dict[str, str] = {}
        self.digests: dict[str, str] = {}
        self.made = self.bytes = 0
        self.failures: list[tuple[str, str]] = []
        self._lacking: list[str] = []
        """Documents that failed, or were not made whole, and that go into the present one."""

    def add(self, document: Document) -> None:
        """Reuse or write a document; one that fails is left out and reported."""
        path = self._folder / document.path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lacking.clear()
        try:
            known = self._known.get(document.key)
            if known is not None:
                _linked(known.path, path)
            else:
                document.write(path, self._ask)
                self.made += 1
        except RoadscanError as error:
            path.unlink(missing_ok=True)
            self.failures.append((document.path, str(error)))
            return
        if self._lacking:
            self.failures.append((document.path, f"was made without {', '.join(self._lacking)}"))
        self.keys[document.path] = "" if self._lacking else document.key  # one that lacks something is never current
        self.digests[document.path] = file_digest(path) if known is None else known.digest
        self.bytes += path.stat().st_size

    def _ask(self, path: str) -> Path:
        """Return an already written document: finer pictures precede coarser ones."""
        if not self.keys.get(path):
            self._lacking.append(path)
        return self._folder / path


def _linked(known: Path, path: Path) -> None:
    """Link a file under another name; copy it where the system has no links."""
    try:
        os.link(known, path)
    except OSError:
        shutil.copyfile(known, path)


def _report(material: Material) -> Any:
    record = material.session.manifest.get(REPORT, REPORT)
    return record if record is not None and material.store.exists(record.path) else None


def _lost_report(material: Material) -> list[str]:
    """Return what is wrong with a report that was written and is not there any more."""
    record = material.session.manifest.get(REPORT, REPORT)
    if record is None or _report(material) is not None:
        return []
    return [f"{material.store.path(record.path)} is missing: `roadscan report` writes it again"]


def _crs(frame: MapFrame) -> dict[str, Any]:
    crs = None if frame.crs is None else crs_from_text(frame.crs)
    authority = None if crs is None else crs.to_authority()
    return {
        "name": (frame.local_name or "local") if crs is None else crs.name,
        "authority": None if authority is None else ":".join(authority), "is_local": frame.is_local,
        "wkt2": frame.wkt(), "proj4": None if crs is None else _proj4(crs),
        "horizontal_unit": {
            "name": "metre" if crs is None else crs.axis_info[0].unit_name, "m": frame.horizontal_unit_m,
        },
        "vertical_unit": {"name": frame.vertical_unit, "m": frame.vertical_unit_m}, "height": frame.height,
        "geoid": None if frame.geoid is None else frame.geoid.grid,
    }  # fmt: skip


def _proj4(crs: Any) -> str:
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # warns that such a text loses what the WKT beside it keeps
        return str(crs.to_proj4())


def _origin(material: Material) -> list[float]:
    """Return a whole-metre position near the survey, which is subtracted before coordinates become 32-bit floats."""
    extent_m, heights = material.extent_m, _heights(material)
    if extent_m is None:
        return [0.0, 0.0, 0.0]
    low = (extent_m[0], extent_m[1], 0.0 if heights is None else heights[0])
    return [float(v // 10 * 10) for v in low]


def _box_of(layers: Sequence[Mapping[str, Any]]) -> Box | None:
    """Return the box of all layers, for a survey without tiles; None without any."""
    boxes = [part["bounds_m"] for layer in layers for part in layer["parts"]]
    if not boxes:
        return None
    west, south, east, north = zip(*boxes, strict=True)
    return min(west), min(south), max(east), max(north)


def _heights(material: Material) -> list[float] | None:
    summaries = material.summaries.values()
    return [min(s.height_min_m for s in summaries), max(s.height_max_m for s in summaries)] if summaries else None


def _longitude_latitude(frame: MapFrame, extent_m: Box | None) -> list[float] | None:
    if frame.crs is None or extent_m is None:
        return None
    import numpy as np

    middle = np.array([[(extent_m[0] + extent_m[2]) / 2, (extent_m[1] + extent_m[3]) / 2]])
    return [round(v, 8) for v in to_longitude_latitude(frame)(middle)[0].tolist()]


_AROUND_M: Final = 2000.0
"""Margin around the survey (m): people also look for places beside the road."""
_WITHIN_M: Final = 0.05
"""Largest error of the polynomials (m): a tenth of what a street map shows when it is opened."""
_MOST: Final = 9
"""Highest degree: 55 numbers per axis; a survey that needs more spans continents."""
_ALONG: Final = 24
"""Places of the fit along each side; the check uses twice as many, between them."""


def degrees_on_map(frame: MapFrame, extent_m: Box | None) -> dict[str, Any] | None:
    """Return polynomials from longitude and latitude (degrees, WGS 84) to easting and northing (m).

    They are within 5 cm of PROJ over the survey and 2 km around it; None for a local map, and where none is as near.
    With x = (longitude − `middle`[0]) / `half`[0] and y of the latitude alike, each of -1 to 1, easting and northing
    are the sums of c · x^i · y^j over the terms i + j ≤ `degree`, i from 0, then j from 0.
    """
    if frame.crs is None or extent_m is None:
        return None
    west, south, east, north = extent_m
    edge = np.linspace(0.0, 1.0, 9)
    ring = np.array([(x, y) for x in edge for y in edge])
    size = np.array([east - west + 2 * _AROUND_M, north - south + 2 * _AROUND_M])
    lon_lat = to_longitude_latitude(frame)(np.array([west - _AROUND_M, south - _AROUND_M]) + ring * size)
    if not np.isfinite(lon_lat).all():
        return None
    low, high = lon_lat.min(axis=0), lon_lat.max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    onto_map = from_longitude_latitude(frame)
    fit, check = (_square(count) for count in (_ALONG, 2 * _ALONG + 1))
    wanted, checked = (onto_map(middle + places * half) for places in (fit, check))
    if not (np.isfinite(wanted).all() and np.isfinite(checked).all()):
        return None
    for degree in range(1, _MOST + 1):
        factors = np.linalg.lstsq(_terms(fit, degree), wanted, rcond=None)[0]
        error_m = float(np.abs(_terms(check, degree) @ factors - checked).max())
        if error_m <= _WITHIN_M:
            return {
                "middle": middle.tolist(), "half": half.tolist(), "degree": degree, "easting": factors[:, 0].tolist(),
                "northing": factors[:, 1].tolist(), "error_m": round(error_m, 4),
            }  # fmt: skip
    return None


def _square(count: int) -> Float64:
    steps = np.linspace(-1.0, 1.0, count)
    return np.array([(x, y) for x in steps for y in steps])


def _terms(places: Float64, degree: int) -> Float64:
    x, y = places.T
    return np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])
