"""Limits fall by themselves, and rise only with a reason: each rule with a file that breaks it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.house import __main__ as command
from tests.house import figures, limits
from tests.house.limits import Limit
from tests.house.uncalled import uncalled

FOUND = {"lines": 120, "files": 7}


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a limits file that is committed, with 100 lines and 9 files, where 120 and 7 are found."""
    file = tmp_path / "limits.toml"
    file.write_text('"lines" = 100\n"files" = 9\n')
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "limits")
    monkeypatch.setattr(limits, "LIMITS", file)
    monkeypatch.setattr(command, "figures", lambda: FOUND)
    return file


def git(folder: Path, *words: str) -> None:
    """Run git without the hooks and the name of whoever tests."""
    settings = ("user.name=a", "user.email=a@b", "core.hooksPath=/dev/null", "commit.gpgsign=false")
    subprocess.run(["git", *(part for one in settings for part in ("-c", one)), *words], cwd=folder, check=True)


def ends(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """Return the code with which the command ends."""
    monkeypatch.setattr(sys, "argv", ["house", *words])
    return command.main()


def test_lowering_raises_nothing(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fell is written; what is above its limit is refused."""
    assert ends(monkeypatch, "--lower") == 1
    assert limits.parsed(house.read_text()) == {"lines": Limit(100), "files": Limit(7)}


def test_an_emptied_file_is_not_filled(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file that is emptied first gets no limit by lowering."""
    house.write_text("")
    assert ends(monkeypatch, "--lower") == 1
    assert limits.read() == {}


def test_a_rise_has_a_reason(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason stands beside the limit, and the check passes with it; a limit that is not exceeded stays."""
    assert ends(monkeypatch, "--raise", "*", "loops of the tie points") == 0
    assert house.read_text() == '"lines" = [120, "loops of the tie points"]\n"files" = 9\n'
    assert ends(monkeypatch) == 0


@pytest.mark.parametrize(
    "words", [("lines", "loops"), ("files", "a good reason"), ("lines", "merge: loops of the tie points")]
)
def test_what_is_no_rise_is_refused(house: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, str]) -> None:
    """A single word is no reason, nor is a merge, and what is not exceeded does not rise."""
    before = house.read_text()
    with pytest.raises(SystemExit, match=r"is no reason|no figure"):
        ends(monkeypatch, "--raise", *words)
    assert house.read_text() == before


@pytest.mark.parametrize("text", ['"lines" = 120\n"files" = 9\n', '"lines" = 120\n', '"files" = 7\n"lines" = 130\n'])
@pytest.mark.parametrize("committed", [False, True])
def test_an_edited_limit_is_refused(
    house: Path, monkeypatch: pytest.MonkeyPatch, text: str, *, committed: bool
) -> None:
    """A number that was edited to be higher is seen against the last commit, and against the one before it."""
    house.write_text(text)
    if committed:
        git(house.parent, "commit", "-qam", "more")
    assert ends(monkeypatch) == 1


def test_an_old_reason_serves_no_new_rise(house: Path) -> None:
    """A second rise needs words of its own."""
    first, second = {"lines": Limit(110, "the first feature")}, {"lines": Limit(120, "the first feature")}
    assert limits.unexplained(second, first)
    assert not limits.unexplained({"lines": Limit(120, "the second feature")}, first)


def test_a_new_name_needs_a_reason() -> None:
    """The limit of a new feature passes with words, is named without them, and hides no other's rise."""
    before = {"lines": Limit(100)}
    assert limits.unexplained({**before, "lines of levels": Limit(90, "the level of each tile")}, before) == []
    (told,) = limits.unexplained({**before, "lines of levels": Limit(90)}, before)
    assert told == "lines of levels: its limit is new and has no reason beside it"
    assert len(limits.unexplained({"lines of levels": Limit(90), "lines": Limit(101)}, before)) == 2


@pytest.mark.parametrize("name", figures.WAYS)
def test_a_way_begins_at_a_format(name: str) -> None:
    """Each way is measured from the log."""
    assert figures.WAYS[name][0].startswith("roadscan.formats.")


def test_files_with_words_of_llvm_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names that are handed on count as those that are imported from LLVM itself; names of the compiler do not."""
    texts = {
        "a.py": "from roadscan.compute.numba_internals import ir, types\n",
        "b.py": "from roadscan.compute.numba_internals import (\n    KNOWN,\n    cgutils,\n)\n",
        "c.py": "from roadscan.compute.numba_internals import (\n    KNOWN,\n)\nfrom x import (\n    ir,\n)\n",
        "d.py": "from numba.core import types\n",
    }
    monkeypatch.setattr(figures, "sources", lambda: {Path(name): text for name, text in texts.items()})
    found = {"files with private names of Numba": 1, "kernel files with LLVM words": 2}
    assert figures.private_names() == found


def test_what_nothing_calls_is_named() -> None:
    """Functions that call themselves alone, methods whose name is a variable elsewhere, and classes that none makes."""
    first = """
from pydantic import field_validator
def called(): return _inner()
def _inner(): return 1
def alone(n): return alone(n - 1)
def promised(): pass
def done(): pass
class Made:
    def seen(self): return self
    def hidden(self): return done()
class Never:
    def gone(self): pass
class Handler(BaseHTTPRequestHandler):
    def do_GET(self): pass
class Kind(Format):
    @field_validator("a")
    def checks(self): pass
"""
    second = "from roadscan.a import called, Made\nhidden = alone = called()\nprint(hidden, alone, Made().seen())\n"
    texts = {Path("roadscan/a.py"): first, Path("roadscan/b.py"): second}
    found = uncalled(texts, {}, "A function that is `promised(now)`, and words like done.")
    assert found == [f"roadscan/a.py:{name}" for name in ("alone", "hidden", "Never", "gone")]
    assert "roadscan/a.py:Never" not in uncalled(texts, {Path("flows/c.py"): "from roadscan.a import Never\n"}, "")


def test_the_limits_of_the_repository_hold() -> None:
    """No limit of the repository rose without words."""
    assert limits.unexplained(limits.read(), limits.earlier()) == []
