"""Takes edits from the page into the inventory, as `roadscan inventory pull` does."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from roadscan.inventory.homes.page_edits import PageDocument
from roadscan.inventory.of_survey import page_document, truth_of
from roadscan.run.session import Session


class EditDoor:
    """Applies documents of edits, one after another."""

    def __init__(self, open_session: Callable[[], Session]) -> None:
        self._open = open_session
        self._alone = threading.Lock()

    def take(self, content: bytes, who: str = "") -> dict[str, Any]:
        """Apply all sound edits of a document; the answer has the result of each, in the order of the document.

        who : their author, as a proxy told it; "" where the document itself says who edited.

        Raises
        ------
        HomeError
            where it is no such document, or made of another inventory.
        """
        with self._alone:
            session = self._open()
            document: PageDocument = page_document(session, "the page", content).by(who)
            pulled, outcomes = truth_of(session).pull_page(document, sound=True)
        told = [one._asdict() for one in outcomes]
        return {"commit": pulled.commit, "edits": told, "conflicts": pulled.conflicts}
