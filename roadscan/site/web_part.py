"""The built web part, which a browser runs. Node makes it from `viewer/`, and the wheel contains it."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any, Final

from roadscan.core.errors import ConfigError
from roadscan.site.document import Ask, Document
from roadscan.store.digest import file_digest

HOW_TO_BUILD: Final = "build it with `make viewer` (it needs Node), or install roadscan from a wheel, which holds it"
PAGE: Final = "index.html"
SINGLE: Final = "single.html"
DATA_MARK: Final = "<!--roadscan-data-->"
"""Mark in the single page at which its documents are inserted."""


def web_folder() -> Path | None:
    """Return the folder of the built web part: of the installed package, else of the checkout; None if not built."""
    package = Path(str(resources.files("roadscan")))
    for folder in (package / "viewer" / "dist", package.parent / "viewer" / "dist"):
        if (folder / PAGE).is_file():
            return folder
    return None


def web_documents() -> Iterator[Document]:
    """Yield the page and its files; nothing where it was not built."""
    folder = web_folder()
    if folder is None:
        return
    for file in [folder / PAGE, *sorted((folder / "app").rglob("*"))]:
        if file.is_file():
            yield Document(file.relative_to(folder).as_posix(), file_digest(file), _copied(file))


def single_page() -> str:
    """Return the self-contained page, with a mark where data are inserted.

    Raises
    ------
    ConfigError
        where it was not built.
    """
    folder = web_folder()
    file = None if folder is None else folder / SINGLE
    if file is None or not file.is_file():
        raise ConfigError("the page for a single file is not there", expected=SINGLE, change=HOW_TO_BUILD)
    text = file.read_text(encoding="utf-8")
    if text.count(DATA_MARK) != 1:
        raise ConfigError(f"{SINGLE} has {text.count(DATA_MARK)} places for data", expected="one", change=HOW_TO_BUILD)
    return text


def _copied(source: Path) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        path.write_bytes(source.read_bytes())

    return write
