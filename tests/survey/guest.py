"""What another user of the machine tries, in a process of his own: ``python guest.py < QUESTION.json``.

It starts as root, loads what it needs (another user may be unable to read this installation) and becomes that user. It
knows nothing of roadscan. Ports: Dask's handshake in the clear, by TLS without a certificate, by TLS with one that he
made, and a web page. Folder: each file below it. The answer, as JSON, says what he got.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import ssl
import sys
import urllib.request
from collections.abc import Awaitable, Callable
from http.client import HTTPException
from pathlib import Path
from typing import Any

from distributed import Security
from distributed.comm import connect

PATIENCE_S = 8.0


async def in_the_clear(port: int) -> Any:
    """As a Dask client without any setting."""
    return await _identity(f"tcp://127.0.0.1:{port}", {})


async def without_certificate(port: int) -> Any:
    """By TLS, trusting whoever answers, with no certificate of one's own."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return await _identity(f"tls://127.0.0.1:{port}", {"ssl_context": context, "require_encryption": True})


OWN_CERTIFICATE = Security.temporary().get_connection_args("client")
OWN_CERTIFICATE["ssl_context"].verify_mode = ssl.CERT_NONE


async def with_own_certificate(port: int) -> Any:
    """The same, with a certificate of one's own."""
    return await _identity(f"tls://127.0.0.1:{port}", OWN_CERTIFICATE)


async def web_page(port: int) -> Any:
    """As a browser."""

    def get() -> int:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=PATIENCE_S) as page:
            return int(page.status)

    return await asyncio.to_thread(get)


async def _identity(address: str, arguments: dict[str, Any]) -> Any:
    comm = await connect(address, timeout=PATIENCE_S, **arguments)
    try:
        await comm.write({"op": "identity", "reply": True})
        return (await comm.read())["type"]
    finally:
        comm.abort()


WAYS: tuple[Callable[[int], Awaitable[Any]], ...] = (in_the_clear, without_certificate, with_own_certificate, web_page)


NO_ANSWER = (OSError, TimeoutError, ValueError, MemoryError, HTTPException)
"""A refusal, or bytes that are not of the protocol that was asked for."""


async def answers(port: int) -> dict[str, str]:
    """What answered at a port, by the way of asking."""
    got = {}
    for way in WAYS:
        try:
            got[way.__name__] = str(await asyncio.wait_for(way(port), PATIENCE_S))
        except NO_ANSWER:
            continue
    return got


async def _all(ports: list[int]) -> dict[int, dict[str, str]]:
    return dict(zip(ports, await asyncio.gather(*map(answers, ports)), strict=True))


def readable(folder: str) -> list[str]:
    """Files below a folder that can be read."""
    found = []
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place) / name
            try:
                with path.open("rb") as stream:
                    stream.read(1)
            except OSError:
                continue
            found.append(str(path))
    return found


def secrets(processes: list[int]) -> list[str]:
    """What can be read of processes beyond their command lines, and command lines that hold a key."""
    found = []
    for number in processes:
        place = Path(f"/proc/{number}")
        if b"PRIVATE KEY" in (place / "cmdline").read_bytes():
            found.append(f"{place}/cmdline")
        for name in ("environ", "maps", "mem", "cwd/.", "fd/0"):
            try:
                (place / name).stat() if name.endswith(".") else (place / name).open("rb").close()
            except OSError:
                continue
            found.append(str(place / name))
    return found


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # asked once as root: all is loaded then
        PATIENCE_S = 0.5
        asyncio.run(_all([silent.getsockname()[1]]))
        PATIENCE_S = 8.0
    os.setgroups([])
    os.setgid(asked["group"])
    os.setuid(asked["user"])
    json.dump(
        {
            "user": os.getuid(),
            "answers": asyncio.run(_all(asked["ports"])),
            "readable": readable(asked["folder"]),
            "secrets": secrets(asked["processes"]),
        },
        sys.stdout,
    )
