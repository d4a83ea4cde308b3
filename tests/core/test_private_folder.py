"""The cache of compiled kernels is code: it is refused where another user can write to it, or did."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from roadscan.core.private_folder import UnsafeFolderError, check_private, kept, make_private

NOBODY = 65534
as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to another user")


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    folder = tmp_path / "base" / "roadscan" / "kernels-0"
    make_private(folder)
    (folder / "a.nbi").write_bytes(b"code")
    return folder


def test_a_folder_of_ones_own_is_trusted(cache: Path) -> None:
    check_private(cache)
    check_private(cache / "not there")
    assert all(place.stat().st_mode & 0o777 == 0o700 for place in (cache, cache.parent, cache.parent.parent))


def test_a_folder_below_one_like_tmp_is_trusted(cache: Path) -> None:
    cache.parent.parent.chmod(0o1777)
    check_private(cache)


WAYS: dict[str, tuple[Callable[[Path], None], str]] = {
    "folder": (lambda cache: cache.chmod(0o777), "kernels-0: .*every user"),
    "folder that is sticky": (lambda cache: cache.chmod(0o1777), "kernels-0: .*every user"),
    "above": (lambda cache: cache.parent.parent.chmod(0o757), "base: .*every user"),
    "file": (lambda cache: (cache / "a.nbi").chmod(0o666), "a.nbi: .*every user"),
}


@pytest.mark.parametrize("way", sorted(WAYS))
def test_what_others_can_write_is_refused(cache: Path, way: str) -> None:
    spoil, words = WAYS[way]
    spoil(cache)
    with pytest.raises(UnsafeFolderError, match=words + ".*chmod go-w .*NUMBA_CACHE_DIR"):
        check_private(cache)


def share_with_group(cache: Path) -> None:
    os.chown(cache, -1, NOBODY)
    cache.chmod(0o770)


def plant_a_link(cache: Path) -> None:
    (cache / "b.nbi").symlink_to("/x")
    os.lchown(cache / "b.nbi", NOBODY, -1)


GIVEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "folder": (lambda cache: os.chown(cache, NOBODY, -1), "kernels-0: .*another user"),
    "above": (lambda cache: os.chown(cache.parent, NOBODY, -1), "roadscan: .*another user"),
    "file": (lambda cache: os.chown(cache / "a.nbi", NOBODY, -1), "a.nbi: .*another user"),
    "group": (share_with_group, "kernels-0: .*its group"),
    "link": (plant_a_link, "b.nbi: .*another user"),
}


@as_root
@pytest.mark.parametrize("way", sorted(GIVEN))
def test_what_belongs_to_others_is_refused(cache: Path, way: str) -> None:
    spoil, words = GIVEN[way]
    spoil(cache)
    with pytest.raises(UnsafeFolderError, match=words):
        check_private(cache)


POISON = """
import pickle, sys
from pathlib import Path

class Code:
    def __reduce__(self):
        return (exec, (f"open({str(Path(sys.argv[1]) / 'owned')!r}, 'w')",))

for index in Path(sys.argv[1]).rglob("*.nbi"):
    head, _, _ = index.read_bytes().partition(b"\\x80")
    index.write_bytes(pickle.dumps(__import__("numba").__version__) + pickle.dumps(Code()))
"""


@pytest.mark.slow
def test_a_poisoned_cache_is_not_run(tmp_path: Path) -> None:
    """What another user put there would be executed: it is, where the folder is trusted, so the test bites."""
    base = tmp_path / "shared"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(base)}
    ask = "import numpy as np; from roadscan.poses.kernels.poses import slope_weights; "
    ask += "slope_weights(np.array([0.0, 1.0, 2.0]), 1.0, np.zeros(3))"

    def computed() -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", ask]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    assert computed().returncode == 0
    subprocess.run([sys.executable, "-c", POISON, str(base)], check=True)
    (poisoned,) = {file.parent for file in base.rglob("*.nbi")}
    poisoned.chmod(0o777)
    done = computed()
    assert done.returncode != 0 and "UnsafeFolderError" in done.stderr and str(poisoned) in done.stderr
    assert not (base / "owned").exists()
    poisoned.chmod(0o700)
    computed()
    assert (base / "owned").exists()


@pytest.mark.slow
def test_the_command_line_says_it_in_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o777)
    folder.chmod(0o777)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    command = [sys.executable, "-m", "roadscan", "demo", "--out", str(tmp_path / "demo")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert f"roadscan: {folder}: the cache of compiled code can be written by every user" in done.stderr


def test_what_is_kept_follows_the_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process whose place changes keeps nothing more in the former one."""
    for place in ("first", "second"):
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / place))
        assert kept("a text", lambda: place) == place  # noqa: B023
        assert kept("a text", lambda: "another") == place
