"""Witnesses check whether an input is true; findings report what they found."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final, Literal

ReportedIn = Literal["error", "rejects", "findings"]
"""Where a fault is reported: ``error`` ends the command or the log with a message; ``rejects`` counts the records in
the summary and lists each in the table `rejects`; ``findings`` is a line of summary, `status` and report."""


@dataclass(frozen=True)
class Witness:
    """A check that can show an input to be wrong. `docs/witnesses.md` lists all; each is a constant of the module that
    applies it, and a test names it with ``@pytest.mark.witness("name")``.
    """

    name: str
    """Lower case with underscores, such as ``pose_leap``."""
    input: str
    """Kind of input: ``trajectory``, ``lidar``, ``profiler``, ``control points``, …"""
    fault: str
    """What can be wrong with it: one sentence."""
    asks: str
    """The witness: what the input is compared with."""
    does: str
    """What the run does on a contradiction: what is left out, refused or kept."""
    told: tuple[ReportedIn, ...]
    """Where the result is reported."""

    def finds(self, subject: str, text: str, left_out: int = 0) -> Finding:
        """Return a finding of this witness about an input.

        Parameters
        ----------
        subject : log (its path in the survey file), control point or run; "" for the log that is being read.
        text : what arrived, what contradicts it, by how much, and what the run did with it: whole sentences.
        left_out : how many records, readings or points were left out; 0 where all are used.
        """
        return Finding(self.name, subject, text, left_out)


@dataclass(frozen=True)
class Finding:
    """The result of a witness for an input of this survey."""

    witness: str
    """Name of the witness."""
    subject: str
    """Log (its path in the survey file), control point or run."""
    text: str
    """What arrived, what contradicts it, by how much, and what the run did with it."""
    left_out: int = field(default=0)
    """How many records, readings or points were left out; 0 where all are used."""

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Finding:
        """Return the finding of a JSON object in a record."""
        return cls(**stored)

    @property
    def line(self) -> str:
        """Return subject and text as the summary prints them."""
        return f"{self.subject}: {self.text}" if self.subject else self.text


_PACKAGE: Final = "roadscan"


def witnesses() -> dict[str, Witness]:
    """Return all witnesses by name, sorted: the constants of this class in all modules of roadscan (imports each).

    Raises
    ------
    ValueError
        where two have one name.
    """
    package, found = import_module(_PACKAGE), dict[str, Witness]()
    for module in pkgutil.walk_packages(package.__path__, f"{_PACKAGE}."):
        if module.name.endswith("__main__"):
            continue
        for value in vars(import_module(module.name)).values():
            if isinstance(value, Witness) and found.setdefault(value.name, value) != value:
                raise ValueError(f"two witnesses are named {value.name}")
    return dict(sorted(found.items()))
