"""The lease of a store, in a folder and in an object store: one holder, known by more than a name and a number."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from roadscan.core.errors import StoreError
from roadscan.store import lease
from roadscan.store.holders import Process, own_tag, tag_lives
from roadscan.store.lease import LEASE_S, ObjectPlace
from roadscan.store.store import Store
from tests.conftest import REPOSITORY
from tests.object_store import ObjectStore, served

HOLDER = """
import sys, time
from roadscan.store.store import Store
with Store(sys.argv[1], "s1").lock():
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture(scope="module")
def objects() -> Iterator[ObjectStore]:
    with served() as store:
        yield store


@pytest.fixture(params=["folder", "memory", "s3"])
def url(request: pytest.FixtureRequest, tmp_path: Path, objects: ObjectStore) -> str:
    return {"folder": str(tmp_path), "memory": f"memory://{tmp_path.name}", "s3": f"{objects.url}/{tmp_path.name}"}[
        request.param
    ]


def put(store: Store, process: Process) -> None:
    """Let a lease stand that another process wrote just now."""
    content = json.dumps({"name": "another", **process.fields()}).encode()
    store.write_bytes("manifest/lock", content)


def elsewhere() -> Process:
    """Return a process in a container of this machine that has its name, and this process's number."""
    this = Process.this()
    return Process(this.host, this.kernel, "pid:[1]", this.pid, this.started)


def test_a_second_run_is_refused_in_words_and_at_once(url: str) -> None:
    store, again = Store(url, "s1"), Store(url, "s1")
    with store.lock():
        began = time.perf_counter()
        with pytest.raises(StoreError, match=rf"process {os.getpid()} on .* is working on this store"), again.lock():
            pass
        with pytest.raises(StoreError, match="is working on this store"):
            again.check_free()
        assert time.perf_counter() - began < 2.0
    store.check_free()
    with store.lock():
        pass


@pytest.mark.slow
def test_of_runs_that_begin_at_once_one_has_the_store(url: str) -> None:
    inside: list[int] = []
    together: list[int] = []

    def often(me: int) -> None:
        for _ in range(15):
            try:
                with Store(url, "s1").lock():
                    inside.append(me)
                    together.append(len(inside))
                    time.sleep(0.002)
                    inside.pop()
            except StoreError as error:
                assert "working on this store" in str(error) or "changes hands" in str(error)

    with ThreadPoolExecutor(3) as threads:
        list(threads.map(often, range(3)))
    assert set(together) == {1}


def test_the_living_lease_of_a_container_with_this_name_and_number_is_not_taken(url: str) -> None:
    store = Store(url, "s1")
    put(store, elsewhere())
    said = r"\(seen \d+ s ago\) is working .*free 40 s after it was last seen"
    with pytest.raises(StoreError, match=said), store.lock():
        pass


@pytest.mark.slow
def test_the_dead_lease_of_a_container_is_taken_when_it_is_over(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A container with a fixed name, whose dead lock names the next run itself."""
    store = Store(url, "s1")
    put(store, elsewhere())
    monkeypatch.setattr(lease, "LEASE_S", 1.0)
    time.sleep(2.2)  # an object store's clock ticks in whole seconds
    with store.lock():
        pass


def test_the_number_of_a_dead_process_given_anew_is_not_its(url: str) -> None:
    this = Process.this()
    store = Store(url, "s1")
    put(store, Process(this.host, this.kernel, this.numbers, this.pid, "1"))
    with store.lock():
        pass


def test_a_killed_holder_of_this_machine_is_followed_at_once(url: str) -> None:
    if url.startswith("memory"):
        pytest.skip("no other process sees it")
    with subprocess.Popen([sys.executable, "-c", HOLDER, url], stdout=subprocess.PIPE, cwd=REPOSITORY) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(StoreError, match=rf"process {holder.pid} on .* is working"), Store(url, "s1").lock():
            pass
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    with Store(url, "s1").lock():
        pass


@pytest.mark.slow
def test_a_lease_is_renewed_while_it_is_held(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lease, "_RENEW_S", 0.3)
    monkeypatch.setattr(lease, "LEASE_S", 2.0)
    store = Store(url, "s1")
    with store.lock():
        # as another machine sees it
        monkeypatch.setattr(Process, "lives", property(lambda _: None))
        for _ in range(2):
            time.sleep(1.1)
            with pytest.raises(StoreError, match="is working on this store"), Store(url, "s1").lock():
                pass


def test_a_run_that_lost_its_lease_writes_nothing_more(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It slept (SIGSTOP, a laptop's lid), another run took the store, and it wakes."""
    monkeypatch.setattr(lease, "_RENEW_S", 3600.0)
    store = Store(url, "s1")
    with store.lock():
        store.write_bytes("manifest/before", b"")
        other = Store(url, "s1")
        put(other, elsewhere())
        monkeypatch.setattr(lease, "_RENEW_S", LEASE_S)  # it has not been renewed in time
        for change in (
            lambda: store.write_bytes("manifest/after", b""),
            lambda: store.remove("manifest/before"),
        ):
            with pytest.raises(StoreError, match=r"this run lost the store: process \d+ on .* has taken it"):
                change()
    assert store.exists("manifest/before") and not store.exists("manifest/after")
    assert b"another" in other.read_bytes("manifest/lock")  # it is not this run's to give back


def test_two_that_find_an_old_lease_do_not_both_take_it(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both have seen the same old lease before either takes it."""
    if url.startswith("memory"):
        pytest.skip("it has no condition for writing over")
    monkeypatch.setattr(Process, "lives", property(lambda _: False))
    store = Store(url, "s1")
    put(store, elsewhere())

    def place() -> object:
        held: list[object] = []
        monkeypatch.setattr(lease.Lease, "take", lambda self: held.append(self._place))
        monkeypatch.setattr(lease.Lease, "give_back", lambda _: None)
        with Store(url, "s1").lock():
            pass
        return held[0]

    one, other = place(), place()
    first, second = one.read(), other.read()  # type: ignore[attr-defined]
    assert one.replace(first, b'{"name": "one"}')  # type: ignore[attr-defined]
    assert not other.replace(second, b'{"name": "other"}')  # type: ignore[attr-defined]
    assert one.read().name == "one"  # type: ignore[attr-defined]


def test_an_object_is_not_written_over_without_its_condition(objects: ObjectStore) -> None:
    store = Store(f"{objects.url}/conditions", "s1")
    place = ObjectPlace(store.fs, store.path("manifest/lock"))
    assert place.create(b"one")
    assert not place.create(b"two")
    held = place.read()
    assert held is not None and held.content == b"one"
    assert abs(place.now_s() - held.renewed_s) < 5.0


def test_temporary_files_of_other_machines_stay_for_hours(tmp_path: Path) -> None:
    store = Store(str(tmp_path), "s1")
    staging = Path(store.path(".staging"))
    others, own = staging / "0a0a0a0a-17-99-abc", staging / f"{own_tag()}-abc"
    dead, old = staging / f"{own_tag().partition('-')[0]}-99999999-5-abc", staging / "0a0a0a0a-18-99-abc"
    for folder in (others, own, dead, old):
        folder.mkdir(parents=True)
    os.utime(old, (1.0, 1.0))
    with store.lock():
        assert others.exists() and own.exists()
        assert not dead.exists() and not old.exists()
    assert tag_lives(own.name) and tag_lives(others.name) is None


def test_a_namespace_of_its_own_is_not_seen(tmp_path: Path) -> None:
    """With the kernel's own means of containers: the same name, and number 1 beside number 1."""
    command = [
        "unshare",
        "--fork",
        "--pid",
        "--mount-proc",
        "--kill-child",
        sys.executable,
        "-c",
        HOLDER,
        str(tmp_path),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=REPOSITORY) as holder:
        assert holder.stdout is not None
        if holder.stdout.readline() != b"held\n":
            pytest.skip("this machine gives no namespaces of process numbers")
        second = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPOSITORY)
        assert "StoreError: process 1 on" in second.stderr
        assert "(seen " in second.stderr
        holder.kill()
