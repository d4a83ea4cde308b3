"""How the commands show tables and progress.

Arrow without pandas, which it imports before its first array (0.1 s), for commands that make no frame.

Arrow asks once whether pandas is installed. Who makes a frame of a table imports it all the same
(:meth:`pyarrow.Table.to_pandas` asks again); only arrays of pandas' own columns would be taken for any others.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer


def print_table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]], numbers: Collection[str] = ()) -> None:
    """Print rows below their head, in columns as wide as they need; those of `numbers` end on one line."""
    widths = [max(len(str(r[i])) for r in [head, *rows]) for i in range(len(head))]
    aligned = [str.rjust if name in numbers else str.ljust for name in head]
    for row in [head, tuple("─" * w for w in widths), *rows]:
        typer.echo("  ".join(to(str(v), w) for v, w, to in zip(row, widths, aligned, strict=True)).rstrip())


def print_json(value: Any) -> None:
    """Print values as JSON; numbers and texts as they are, anything else in words."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, default=str))


def print_whole(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    """The same on a terminal: what is wider is folded within its column, and nothing is cut."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for name in head:
        table.add_column(Text(name), overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    Console().print(table)


def new_reporter() -> Any:
    """What shows a run's progress: bars on a terminal, lines in a pipe."""
    from roadscan.run.progress import LineReporter, TerminalReporter

    return TerminalReporter() if sys.stderr.isatty() else LineReporter()


@contextmanager
def looking(file: Path) -> Iterator[Callable[[int, float | None], None]]:
    """Show on a terminal how far a file is read; nothing in a pipe."""
    if not sys.stderr.isatty():
        yield lambda rows, share: None
        return
    from rich.console import Console

    with Console(stderr=True).status(str(file)) as status:

        def show(rows: int, share: float | None) -> None:
            done = "" if share is None else f", {share:.0%}"
            status.update(f"{file}: {rows:,} rows{done}")

        yield show


class _Hidden:
    """Finds no pandas."""

    def find_spec(self, name: str, *_: Any) -> None:
        """Raise an error for pandas; other modules are found elsewhere."""
        if name == "pandas":
            raise ModuleNotFoundError(name=name)


def arrow_alone() -> None:
    """Let Arrow ask for pandas while it is hidden, unless it is loaded already."""
    if "pandas" in sys.modules:
        return
    import pyarrow as pa

    hidden: Any = _Hidden()
    sys.meta_path.insert(0, hidden)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(hidden)
