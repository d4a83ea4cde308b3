"""Writes a site as one self-contained file, because a page opened from a file may load no others."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.run.session import Session
from roadscan.site.material import Material, Wishes
from roadscan.site.site import KEYS, REPORT_PAGE, publish
from roadscan.site.web_part import DATA_MARK, HOW_TO_BUILD, single_page, web_folder
from roadscan.store.holders import beside

LARGEST_MB: Final = 200.0
"""Larger pages open slowly in browsers."""

_TEXT: Final = (".json",)
_NOT_INSIDE: Final = (".parquet", ".vpc", ".tif", ".vrt", ".fgb", ".html")
"""Suffixes of files for other programs, and of separate pages."""
_WEB: Final = ("app/",)
_BASE64: Final = 4 / 3  # growth of bytes encoded as text


@dataclass(frozen=True)
class SinglePage:
    """Result of writing a page."""

    path: Path
    bytes: int
    left_out: tuple[str, ...]
    """Contents that did not fit, or could not be made."""


def write_single(
    material: Material,
    path: Path,
    largest_mb: float = LARGEST_MB,
    report: Callable[[int, int], None] = lambda _a, _b: None,
) -> SinglePage:
    """Write the site of a survey, or of the requested part, as one file.

    Where it would be larger than `largest_mb`, it goes without the pictures of cameras, then without the finest rasters
    one after another, then without the points.

    Raises
    ------
    ConfigError
        where the web part was not built, or the file would be larger all the same.
    """
    page = single_page()
    left_out: list[str] = []
    scratch = beside(path.absolute())
    try:
        folder = scratch / "site"
        for wished, without in _ever_less(material):
            if without:
                left_out.append(without)
            published = publish(wished, folder, report)
            size = round(sum(_size(file) for file in _inside(folder)) + len(page))
            if size <= largest_mb * 1e6:
                break
        else:
            raise ConfigError(
                f"one file would hold {size / 1e6:,.0f} MB even without rasters' details and points",
                expected=f"{largest_mb:g} MB or less", change="name a road or a smaller --box",
            )  # fmt: skip
        _write(path, page, folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    failed = [f"{document}: {why}" for document, why in published.failures]
    return SinglePage(path, path.stat().st_size, (*left_out, *failed))


def _ever_less(material: Material) -> Iterator[tuple[Material, str]]:
    """Yield the material with ever fewer contents, and what each leaves out."""
    wishes = material.wishes
    yield material, ""
    if wishes.pictures:
        wishes = replace(wishes, pictures=False)
        yield replace(material, wishes=wishes), "pictures of cameras"
    pixel_m = max(material.context.grid.cell_m, wishes.finest_pixel_m)
    for _ in range(3):
        pixel_m *= 4
        wishes = replace(wishes, finest_pixel_m=pixel_m)
        yield replace(material, wishes=wishes), f"rasters with pixels finer than {pixel_m:g} m"
    if wishes.clouds:
        yield replace(material, wishes=replace(wishes, clouds=False)), "points"


def _inside(folder: Path) -> list[Path]:
    """Return the files of a site that belong into the page, in a fixed order."""
    found = []
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder).as_posix()
        if file.is_file() and file.suffix not in _NOT_INSIDE and not name.startswith(_WEB) and name != KEYS:
            found.append(file)
    return found


def _size(file: Path) -> float:
    """Return the bytes of a file in the page."""
    return file.stat().st_size * (1.0 if file.suffix in _TEXT else _BASE64) + 100


def _write(path: Path, page: str, folder: Path) -> None:
    """Write the page with all files embedded, atomically."""
    before, after = page.split(DATA_MARK)
    scratch = beside(path.absolute())
    try:
        with scratch.open("wb") as stream:
            stream.write(before.encode())
            for file in _inside(folder):
                name = file.relative_to(folder).as_posix()
                is_text = file.suffix in _TEXT
                kind = "application/json" if is_text else "application/octet-stream"
                stream.write(f'<script type="{kind}" data-path="{name}">'.encode("ascii"))
                content = file.read_bytes()
                stream.write(_without_report(content) if is_text else base64.b64encode(content))
                stream.write(b"</script>\n")
            stream.write(after.encode())
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)


def _without_report(content: bytes) -> bytes:
    """Return a document without the path of the report, which is a separate page."""
    return content.replace(f'"report":"{REPORT_PAGE}"'.encode(), b'"report":null')


PAGE: Final = "page.html"
_FINEST_M: Final = 0.02
"""Finest pixel (m), so that the file takes seconds; finer pixels and the points are for `roadscan view`."""


def page_lines(survey_file: Path) -> list[str]:
    """Return the last lines of a run: the address of its page, or why there is none and how to get it."""
    how = f"roadscan view {survey_file}"
    if web_folder() is None:
        return [f"look at it    {how}", f"              the page is not built yet: {HOW_TO_BUILD}"]
    file = survey_file.parent / PAGE
    try:
        write_single(Material(Session.open(survey_file), Wishes(clouds=False, finest_pixel_m=_FINEST_M)), file)
    except RoadscanError as error:
        return [f"look at it    {how}", f"              its file could not be made: {error}"]
    return [f"look at it    {file.resolve().as_uri()}", f"with points   {how}"]
