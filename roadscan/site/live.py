"""A site whose documents are made on request and cached by their keys."""

from __future__ import annotations

import tempfile
import threading
import uuid
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from roadscan.core.errors import RoadscanError
from roadscan.inventory.of_survey import truth_of
from roadscan.run.session import Session
from roadscan.site.document import Document, site_parts
from roadscan.site.material import Material, Wishes
from roadscan.site.site import ENTRY, first_documents
from roadscan.store.asset_truth import COMMITS
from roadscan.store.store import Store

FOLDER: Final = "site"
"""Folder of documents for `roadscan view`, below the survey's root."""
_OUTPUTS: Final = "manifest/outputs"


class Served(NamedTuple):
    """A document that is ready."""

    file: Path
    key: str


class LiveSite:
    """Documents of a survey's site by path. Several threads may request them; those of one part are made one by one."""

    def __init__(self, open_material: Callable[[], Material]) -> None:
        self._open = open_material
        self._listing = threading.Lock()
        self._making: dict[str, threading.RLock] = defaultdict(threading.RLock)
        self._seen: list[list[str]] = []
        self._listed: dict[str, Document] = {}
        self.material = self._renewed()
        self._cache = _cache_folder(self.material.store)

    def document(self, path: str) -> Served | None:
        """Return a document, made if necessary; None for a path that the site does not have.

        Where the survey has changed since, a page that begins anew (it asks for the entry) gets what holds now.
        """
        if path == ENTRY:
            with self._listing:
                if _stamp(self.material) != self._seen:
                    self.material = self._renewed()
        found = self._listed.get(path) or self._unlisted(path)
        if found is None:
            return None
        file = self._cache / found.key[:2] / f"{found.key}{Path(path).suffix}"
        with self._making[path.partition("/")[0]]:
            if not file.is_file():
                self._make(found, file)
        return Served(file, found.key)

    def _unlisted(self, path: str) -> Document | None:
        part = next((one for one in site_parts() if one.name == path.partition("/")[0]), None)
        return None if part is None else part.find(self.material, path)

    def _make(self, document: Document, file: Path) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        scratch = file.with_name(f".{uuid.uuid4().hex}{file.suffix}")
        try:
            document.write(scratch, self._ask)
            scratch.rename(file)
        finally:
            scratch.unlink(missing_ok=True)

    def _ask(self, path: str) -> Path:
        found = self.document(path)
        if found is None:
            raise FileNotFoundError(path)
        return found.file

    def _renewed(self) -> Material:
        material = self._open()
        self._seen = _stamp(material)
        listed = {one.path: one for one in first_documents(material)}
        for part in site_parts():
            listed |= {one.path: one for one in part.listed(material)}
        self._listed = listed
        return material


def open_survey(
    survey_file: str | Path, over: Sequence[str | Path] = (), *, edited: bool = False
) -> Callable[[], Material]:
    """Return a function that reads a survey, and those shown over it, at each call; damaged records are skipped.

    Parameters
    ----------
    over : surveys that are shown over it; edited : whether people may edit the survey's inventory.
    """
    wishes = Wishes(edits="post" if edited else "", stays_here=True)

    def opened() -> Material:
        sessions = [Session.open(file) for file in (survey_file, *over)]
        for session in sessions:
            session.hear_of_damage()
        return Material(sessions[0], wishes, tuple(sessions[1:]))

    return opened


def _stamp(material: Material) -> list[list[str]]:
    """Return what differs when a survey has changed: its records, and its inventory's commits (maybe elsewhere)."""
    try:
        commits = truth_of(material.session).truth.store.files(COMMITS)
    except RoadscanError:
        commits = []
    return [material.store.files(_OUTPUTS), commits]


def _cache_folder(store: Store) -> Path:
    """Return the cache folder: in the store, or for this process where the store is no folder."""
    if store.is_folder:
        folder = Path(store.path(FOLDER))
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    return Path(tempfile.mkdtemp(prefix="roadscan-site-"))
