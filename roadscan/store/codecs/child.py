"""Runs native decoders in a separate process, so that damaged bytes cannot crash, stall or exhaust the run.

A worker is a file of this folder with a function `opened`, which takes the arguments given here as text and returns a
function from a request to a reply, both bytes. It is run as a script, by this very file, and imports nothing of
roadscan, so that it starts fast.
"""

from __future__ import annotations

import importlib
import struct
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

_WORKERS: Final = Path(__file__).parent
MEMORY_BYTES: Final = 4 << 30
"""Memory limit of a decoder: none needs more, though damaged files may claim more."""

_SIZE: Final = struct.Struct("<q")
"""Header of each request and reply: its length in bytes; negative before the text of an error."""


class ChildError(Exception):
    """A worker could not answer; the message is the decoder's where it gave one."""


class Child:
    """A worker process, started by the first request and again by the first one after a crash; a context manager."""

    def __init__(self, worker: str, *arguments: str) -> None:
        self._command = [sys.executable, "-P", __file__, str(_WORKERS), worker, *arguments]
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def ask(self, request: bytes, timeout_s: float) -> bytes:
        """Send a request and return the reply.

        Raises
        ------
        ChildError
            if the decoder refused, crashed, or took longer; other requests can follow.
        """
        if self._process is None:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
        process, late = self._process, threading.Event()

        def give_up() -> None:
            late.set()
            process.kill()

        watch = threading.Timer(timeout_s, give_up)
        watch.daemon = True
        watch.start()
        try:
            size, reply = _exchanged(process, request)
        finally:
            watch.cancel()
        if size is None:
            self.close()
            raise ChildError(
                f"it took over {timeout_s:.0f} s and was given up" if late.is_set() else "the decoder crashed on it"
            )
        if size < 0:
            raise ChildError(reply.decode(errors="replace"))
        return reply


def _exchanged(process: subprocess.Popen[bytes], request: bytes) -> tuple[int | None, bytes]:
    """Return length and bytes of the reply; None where none came."""
    if process.stdin is None or process.stdout is None:
        return None, b""
    try:
        process.stdin.write(_SIZE.pack(len(request)) + request)
        process.stdin.flush()
        head = process.stdout.read(_SIZE.size)
        size = _SIZE.unpack(head)[0] if len(head) == _SIZE.size else 0
        reply = process.stdout.read(abs(size))
    except OSError:
        return None, b""
    return (size, reply) if size and len(reply) == abs(size) else (None, b"")


def _serve(answer: Any, requests: BinaryIO, replies: BinaryIO) -> None:
    """Answer requests until the input ends."""
    while len(head := requests.read(_SIZE.size)) == _SIZE.size:
        try:
            reply, sign = answer(requests.read(_SIZE.unpack(head)[0])), 1
        except BaseException as error:  # noqa: BLE001 — a panic of Rust is no Exception
            reply, sign = (str(error) or type(error).__name__).encode(), -1
        replies.write(_SIZE.pack(sign * len(reply)) + reply)
        replies.flush()


def _limit_memory() -> None:
    """Limit the process to `MEMORY_BYTES`, where the system can."""
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


def _main(folder: str, worker: str, *arguments: str) -> None:
    _limit_memory()
    sys.path.append(folder)
    _serve(importlib.import_module(worker).opened(*arguments), sys.stdin.buffer, sys.stdout.buffer)


if __name__ == "__main__":
    _main(*sys.argv[1:])
