"""The page behind a proxy: who sees it, who edits, and what the audit keeps."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.site.access import Access
from roadscan.site.live import Served
from roadscan.site.server import Door, SiteServer
from tests.serving import serving

SECRET = "0123456789abcdef0123456789abcdef"
FILE = """
address = "https://roads.example.org"
viewers = ["group:office", "bob"]
editors = ["ann@example.org", "group:inspectors"]
audit = "audit.jsonl"
"""


class Page:
    """One document and one door, which tells who sent what."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "page.json"
        self.file.write_text("{}")
        self.taken: list[tuple[bytes, str]] = []

    def document(self, path: str) -> Served | None:
        return Served(self.file, "k1") if path == "page.json" else None

    def take(self, content: bytes, who: str) -> dict[str, Any]:
        if content == b"bad":
            raise RoadscanError("the edits are bad")
        self.taken.append((content, who))
        return {"commit": 7}


@pytest.fixture
def page(tmp_path: Path) -> Page:
    return Page(tmp_path)


@pytest.fixture
def server(page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SiteServer]:
    monkeypatch.setenv("ROADSCAN_PROXY_SECRET", SECRET)
    file = tmp_path / "ACCESS.toml"
    file.write_text(FILE)
    with serving(SiteServer(page, doors={"edits": Door(page.take, writes=True)}, access=Access.load(file))) as one:
        yield one


def ask(
    server: SiteServer, path: str, *headers: tuple[str, str], content: bytes | None = None
) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of an answer to what a proxy hands on."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.putrequest("GET" if content is None else "POST", path)
    own = (("Origin", "https://roads.example.org"), ("Content-Type", "application/geo+json"))
    sent = () if content is None else (*own, ("X-Roadscan-Edit", server.token), ("Content-Length", str(len(content))))
    for name, value in (*sent, *headers):
        connection.putheader(name, value)
    connection.endheaders(content)
    answer = connection.getresponse()
    told = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return told


def by(name: str = "", groups: str = "", secret: str = SECRET) -> list[tuple[str, str]]:
    """Headers that the proxy adds."""
    told = [("X-Roadscan-Proxy", secret), ("X-Forwarded-User", name), ("X-Forwarded-Groups", groups)]
    return [(header, value) for header, value in told if value]


@pytest.mark.parametrize(
    ("headers", "sees", "edits"),
    [
        (by("ann@example.org"), 200, 200), (by("eva", "drivers, inspectors"), 200, 200),
        (by("bob"), 200, 403), (by("carl", "office"), 200, 403),
        (by("mallory"), 403, 403), (by(), 403, 403), (by("group:inspectors"), 403, 403),
        (by("", "inspectors"), 403, 403),  # a group without a name would leave edits without an author
        (by("ann@example.org", secret=""), 403, 403), (by("ann@example.org", secret=SECRET[:-1]), 403, 403),
        ([*by("ann@example.org"), ("X-Forwarded-User", "bob")], 403, 403),
        ([*by("mallory"), ("X-Forwarded-User", "ann@example.org")], 403, 403),
        ([*by("mallory"), ("X-Forwarded-Groups", "inspectors"), ("X-Forwarded-Groups", "")], 403, 403),
        (by("ann@example.org\x01"), 403, 403), (by("a" * 201, "inspectors"), 403, 403),
    ],
)  # fmt: skip
def test_a_role_is_what_the_file_gives(
    server: SiteServer, page: Page, headers: list[tuple[str, str]], sees: int, edits: int
) -> None:
    assert ask(server, "/page.json", *headers)[0] == sees
    assert ask(server, "/edits", *headers, content=b"{}")[0] == edits
    status, told, _ = ask(server, "/edit", *headers)
    redirected = (303, f"/#edit={server.token}") if edits == 200 else (404 if sees == 200 else sees, None)
    assert (status, told.get("Location")) == redirected
    assert len(page.taken) == (edits == 200)


def test_the_proxy_says_who_edits_and_the_audit_keeps_it(server: SiteServer, page: Page, tmp_path: Path) -> None:
    assert ask(server, "/edits", *by("ann@example.org"), content=b"{}")[0] == 200
    assert page.taken == [(b"{}", "ann@example.org")]
    assert ask(server, "/edits", *by("ann@example.org"), content=b"bad")[0] == 422
    assert ask(server, "/edits", *by("bob"), content=b"{}")[0] == 403
    other = [*by("ann@example.org"), ("Origin", "https://evil.example")]
    assert ask(server, "/edits", *other, content=b"{}")[0] == 403
    lines = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert [(one["who"], one["role"], one["path"], one["outcome"]) for one in lines] == [
        ("ann@example.org", "editor", "/edits", "received"),
        ("ann@example.org", "editor", "/edits", "taken: commit 7"),
        ("ann@example.org", "editor", "/edits", "received"),
        ("ann@example.org", "editor", "/edits", "refused: the edits are bad"),
        ("bob", "viewer", "/edits", "refused: 'bob' may look at this page, and not edit it"),
        ("ann@example.org", "editor", "/edits", "refused: documents are taken from this server's own page alone"),
    ]


def test_nothing_is_taken_without_an_audit(server: SiteServer, page: Page, tmp_path: Path) -> None:
    (tmp_path / "audit.jsonl").mkdir()
    status, _, body = ask(server, "/edits", *by("ann@example.org"), content=b"{}")
    assert (status, page.taken) == (500, []) and b"the audit cannot be kept" in body


def test_everyone_may_look(page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROADSCAN_PROXY_SECRET", SECRET)
    file = tmp_path / "ACCESS.toml"
    file.write_text('address = "https://roads.example.org"\nviewers = ["*"]')
    access = Access.load(file)
    with serving(SiteServer(page, doors={"edits": Door(page.take, writes=True)}, access=access)) as server:
        assert ask(server, "/page.json", *by())[0] == 200
        assert ask(server, "/page.json")[0] == 403
        for headers in (by(), by("ann@example.org")):
            assert ask(server, "/edits", *headers, content=b"{}")[0] == 403
        assert server.address == "https://roads.example.org" and not page.taken


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('address = "roads.example.org"\nviewers = ["*"]', "address 'roads.example.org'; expected one like https"),
        ('address = "https://roads.example.org"', "nobody may see the page"),
        ('address = "https://roads.example.org"\neditors = ["*"]', "everyone would be an editor"),
        ('address = "https://roads.example.org"\nviewer = ["bob"]', "viewers"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, text: str, told: str) -> None:
    file = tmp_path / "ACCESS.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=told):
        Access.load(file)


@pytest.mark.parametrize("secret", ["", "short"])
def test_a_secret_that_can_be_guessed_is_refused(
    page: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, secret: str
) -> None:
    monkeypatch.setenv("ROADSCAN_PROXY_SECRET", secret)
    file = tmp_path / "ACCESS.toml"
    file.write_text(FILE)
    with pytest.raises(ConfigError, match="at least 24 letters and digits in ROADSCAN_PROXY_SECRET"):
        SiteServer(page, access=Access.load(file))
