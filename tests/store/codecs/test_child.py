"""Workers in processes of their own: whatever they do, the run goes on and says what happened."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from roadscan.store.codecs import child
from roadscan.store.codecs.child import Child, ChildError

WORKER = """
import os, time
def answer(request):
    if request == b"refuse": raise ValueError("no such points")
    if request == b"crash": os.abort()
    if request == b"hang": time.sleep(60)
    if request == b"swell": return str(len(bytes(6 << 30))).encode()
    return request[::-1]
def opened(greeting):
    return answer if greeting == "hello" else None
"""


@pytest.fixture
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Child:
    (tmp_path / "echo.py").write_text(WORKER)
    monkeypatch.setattr(child, "_WORKERS", tmp_path)
    return Child("echo", "hello")


@pytest.mark.parametrize(
    ("request_", "match"), [(b"refuse", "no such points"), (b"crash", "crashed"), (b"swell", "Memory")]
)
def test_what_a_worker_does_costs_its_request_alone(worker: Child, request_: bytes, match: str) -> None:
    with worker:
        assert worker.ask(b"abc", 20.0) == b"cba"
        with pytest.raises(ChildError, match=match):
            worker.ask(request_, 20.0)
        assert worker.ask(bytes(1 << 22) + b"1", 20.0) == b"1" + bytes(1 << 22)


def test_a_worker_that_hangs_is_ended(worker: Child) -> None:
    started = time.monotonic()
    with worker, pytest.raises(ChildError, match="given up"):
        worker.ask(b"hang", 0.5)
    assert time.monotonic() - started < 20.0
