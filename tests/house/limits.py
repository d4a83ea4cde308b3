"""The limits of the figures: they fall by themselves, and rise only with a reason that stands beside them."""

from __future__ import annotations

import json
import subprocess
import tomllib
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

LIMITS = Path(__file__).with_name("limits.toml")


class Limit(NamedTuple):
    """The most that a figure may be, and what its last rise was for."""

    most: int
    what_for: str = ""


def parsed(text: str) -> dict[str, Limit]:
    """Return the limits by name: a number, or a number and the reason of its last rise."""
    limits: dict[str, int | list[int | str]] = tomllib.loads(text)
    return {
        name: Limit(value) if isinstance(value, int) else Limit(int(value[0]), str(value[1]))
        for name, value in limits.items()
    }


def read() -> dict[str, Limit]:
    """Return the limits of the file."""
    return parsed(LIMITS.read_text())


def write(limits: Mapping[str, Limit]) -> None:
    """Write the limits, a line each."""
    lines = (
        f'"{name}" = [{limit.most}, {json.dumps(limit.what_for, ensure_ascii=False)}]\n'
        if limit.what_for
        else f'"{name}" = {limit.most}\n'
        for name, limit in limits.items()
    )
    LIMITS.write_text("".join(lines))


def lowered(found: Mapping[str, int], known: Mapping[str, Limit]) -> dict[str, Limit]:
    """Return the limits with those lowered that a figure is below; figures without a limit get none."""
    return {
        name: known[name]._replace(most=min(value, known[name].most)) for name, value in found.items() if name in known
    }


def raised(found: Mapping[str, int], known: Mapping[str, Limit], pattern: str, what_for: str) -> dict[str, Limit]:
    """Return the limits with those raised that match `pattern` and are exceeded or missing.

    Raises
    ------
    SystemExit
        if the reason has fewer than two words or names a merge, or nothing that matches is exceeded.
    """
    if what_for.lower().startswith("merge"):
        raise SystemExit(f"{what_for!r} is no reason: a merge brings lines, say what those lines are for")
    if len(what_for.split()) < 2:
        raise SystemExit(f"{what_for!r} is no reason: say in some words what the rise is for")
    risen = {
        name: Limit(value, what_for)
        for name, value in found.items()
        if fnmatchcase(name, pattern) and (name not in known or value > known[name].most)
    }
    if not risen:
        raise SystemExit(f"no figure that matches {pattern!r} is above its limit")
    merged = {**known, **risen}
    return {name: merged[name] for name in found if name in merged}


def exceeded(found: Mapping[str, int], known: Mapping[str, Limit]) -> list[str]:
    """Return a line for each figure above its limit or without one."""
    return [
        f'{name}: {value:,} is above its limit: python -m tests.house --raise "{name}" "what for"'
        for name, value in found.items()
        if name not in known or value > known[name].most
    ]


def unexplained(known: Mapping[str, Limit], before: Mapping[str, Limit]) -> list[str]:
    """Return a line for each limit that is higher than `before`, or new, without a reason of its own."""
    return (
        [
            f"{name}: its limit rose from {before[name].most:,} to {limit.most:,} without a reason beside it"
            if name in before
            else f"{name}: its limit is new and has no reason beside it"
            for name, limit in known.items()
            if _rose(limit, before.get(name)) and not _has_words_of_its_own(limit, before.get(name))
        ]
        if before
        else []
    )


def _rose(limit: Limit, before: Limit | None) -> bool:
    return before is None or limit.most > before.most


def _has_words_of_its_own(limit: Limit, before: Limit | None) -> bool:
    return limit.what_for not in ("", before.what_for if before else "")


def earlier() -> dict[str, Limit]:
    """Return the limits of the last commit whose file differs from the present one; none where git does not know."""
    present = LIMITS.read_text()
    for commit in ("HEAD", "HEAD^"):
        text = _committed(commit)
        if text is not None and text != present:
            return parsed(text)
    return {}


def _committed(commit: str) -> str | None:
    """Return the text of the file in a commit; None where there is none."""
    shown = subprocess.run(
        ["git", "show", f"{commit}:./{LIMITS.name}"], cwd=LIMITS.parent, capture_output=True, text=True, check=False
    )
    return shown.stdout if shown.returncode == 0 else None
