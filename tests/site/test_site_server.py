"""The server of `roadscan view`: ranges, heads, and what it refuses."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from roadscan.core.errors import StoreError
from roadscan.site.live import LiveSite, Served, open_survey
from roadscan.site.server import Door, SiteServer, range_of
from tests.serving import serving
from tests.surveys import Simulated

CONTENT = bytes(range(256)) * 40


class Held:
    """Two documents, one of which asks for what is outside."""

    def __init__(self, folder: Path) -> None:
        self.asked: list[str] = []
        self.folder = folder
        (folder / "a.laz").write_bytes(CONTENT)

    def document(self, path: str) -> Served | None:
        self.asked.append(path)
        return Served(self.folder / "a.laz", "k1") if path in ("clouds/a.laz", "report.html") else None


@pytest.fixture
def held(tmp_path: Path) -> Held:
    return Held(tmp_path)


@pytest.fixture
def server(held: Held) -> Iterator[SiteServer]:
    with serving(SiteServer(held)) as one:
        yield one


def ask(
    server: SiteServer, path: str, method: str = "GET", headers: dict[str, str] | None = None
) -> tuple[http.client.HTTPResponse, bytes]:
    """Answer of the server, and its body."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for name, value in {"Host": f"127.0.0.1:{server.server_port}", **(headers or {})}.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def test_a_document_is_given_whole_and_by_range(server: SiteServer) -> None:
    answer, body = ask(server, "/clouds/a.laz")
    assert (answer.status, body) == (200, CONTENT)
    assert answer.getheader("Accept-Ranges") == "bytes" and answer.getheader("ETag") == '"k1"'
    for asked, span in (("bytes=10-19", (10, 20)), ("bytes=10000-", (10_000, 10_240)), ("bytes=-7", (10_233, 10_240))):
        answer, body = ask(server, "/clouds/a.laz", headers={"Range": asked})
        assert (answer.status, body) == (206, CONTENT[slice(*span)])
        assert answer.getheader("Content-Range") == f"bytes {span[0]}-{span[1] - 1}/10240"
    answer, _ = ask(server, "/clouds/a.laz", headers={"Range": "bytes=10240-"})
    assert (answer.status, answer.getheader("Content-Range")) == (416, "bytes */10240")


@pytest.fixture
def editable(held: Held) -> Iterator[SiteServer]:
    """A server that takes edits; what it took stands in `held.asked`."""

    def take(content: bytes, _who: str) -> dict[str, str]:
        if content == b"bad":
            raise StoreError("the edits <b>are</b> bad")
        held.asked.append(content.decode())
        return {"took": content.decode()}

    with serving(
        SiteServer(held, doors={"edits": Door(take, writes=True), "measure": Door(take, writes=False)})
    ) as one:
        yield one


def post(
    server: SiteServer, content: bytes = b"<edits>", path: str = "/edits", **headers: str | None
) -> tuple[int, bytes]:
    """Status and body of an answer to a post as the page sends it, but for some headers; None leaves one out."""
    own = {
        "Host": f"127.0.0.1:{server.server_port}", "Origin": f"http://127.0.0.1:{server.server_port}",
        "Content-Type": "application/geo+json", "X-Roadscan-Edit": server.token, "Content-Length": str(len(content)),
    }  # fmt: skip
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.putrequest("POST", path, skip_host=True, skip_accept_encoding=True)
    for name, value in (own | {name.replace("_", "-"): value for name, value in headers.items()}).items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(content)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def test_what_writes_nothing_needs_no_token_but_the_own_page(editable: SiteServer, held: Held) -> None:
    own: dict[str, str | None] = {"path": "/measure", "X_Roadscan_Edit": None, "Content_Type": "application/json"}
    assert post(editable, b"{}", **own)[0] == 200 and held.asked == ["{}"]
    for header, value in (("Origin", "http://elsewhere.example"), ("Origin", None), ("Host", "elsewhere.example")):
        assert post(editable, b"{}", **(own | {header: value}))[0] == 403
    assert post(editable, b"{}", **(own | {"Content_Type": "text/plain"}))[0] == 415
    assert post(editable, b"{}", path="/nowhere")[0] == 405 and held.asked == ["{}"]


def test_edits_of_its_own_page_are_taken(editable: SiteServer, held: Held) -> None:
    assert editable.address.endswith(f"/#edit={editable.token}") and len(editable.token) >= 32
    status, body = post(editable)
    assert (status, json.loads(body), held.asked) == (200, {"took": "<edits>"}, ["<edits>"])
    assert b"<" not in body
    assert post(editable, b"bad") == (422, b"the edits <b>are</b> bad\n")
    assert ask(editable, "/clouds/a.laz")[0].status == 200


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": None}, 403), ({"Origin": "null"}, 403), ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403), ({"Host": "evil.example"}, 403), ({"Host": None}, 403),
        ({"X_Roadscan_Edit": None}, 403), ({"X_Roadscan_Edit": ""}, 403), ({"X_Roadscan_Edit": "\xe9"}, 403),
        ({"X_Roadscan_Edit": "0" * 32}, 403), ({"Content_Type": "text/plain"}, 415),
        ({"Content_Type": None}, 415), ({"Content_Length": None}, 411), ({"Content_Length": "-1"}, 411),
        ({"Content_Length": "999999999999"}, 413), ({"path": "/"}, 405), ({"path": "/clouds/a.laz"}, 405),
    ],
)  # fmt: skip
def test_other_edits_are_refused(editable: SiteServer, held: Held, headers: dict[str, str | None], status: int) -> None:
    assert post(editable, **headers)[0] == status  # type: ignore[arg-type]
    assert held.asked == []


def test_without_being_asked_to_it_takes_no_edits(server: SiteServer, held: Held) -> None:
    assert post(server)[0] == 405
    assert "#" not in server.address and held.asked == []


def test_a_head_has_no_body(server: SiteServer) -> None:
    answer, body = ask(server, "/clouds/a.laz", "HEAD", {"Range": "bytes=0-9"})
    assert (answer.status, body, answer.getheader("Content-Length")) == (206, b"", "10")


@pytest.mark.parametrize(
    ("asked", "span"),
    [
        ("bytes=0-", range(100)), ("bytes=5-5", range(5, 6)), ("bytes=0-999", range(100)), ("bytes=-999", range(100)),
        ("bytes=100-", range(0)), ("bytes=-0", range(0)), ("bytes=9-5", None), ("bytes=0-1,3-4", None),
        ("bytes=-", None), ("pages=0-1", None), ("bytes=a-b", None), ("bytes=" + "9" * 30 + "-", None),
    ],
)  # fmt: skip
def test_ranges(asked: str, span: range | None) -> None:
    found = range_of(asked, 100)
    assert found == span and (found is None) == (span is None)


def test_what_a_browser_holds_is_not_sent_again(server: SiteServer) -> None:
    assert ask(server, "/clouds/a.laz", headers={"If-None-Match": '"k1"'})[0].status == 304
    assert ask(server, "/clouds/a.laz", headers={"If-None-Match": '"k0"'})[0].status == 200
    answer, body = ask(server, "/clouds/a.laz", headers={"Range": "bytes=0-9", "If-Range": '"k0"'})
    assert (answer.status, len(body)) == (200, 10_240)


@pytest.mark.parametrize(
    "path",
    [
        "/../etc/passwd", "/%2e%2e/etc/passwd", "/clouds/../a.laz", "/clouds/%2e%2e/%2e%2e/x", "/.hidden",
        "/clouds/.keys", "/a%00.laz", "/a\\b", "/C:/x", "/%252e%252e/x", "/%C3%A9", "/x" * 5000,
    ],
)  # fmt: skip
def test_no_path_leaves_the_site(server: SiteServer, held: Held, path: str) -> None:
    answer, body = ask(server, path)
    assert answer.status == 404
    assert b"root" not in body
    assert held.asked == []


def test_paths_that_it_does_not_have(server: SiteServer, held: Held) -> None:
    answer, body = ask(server, "/rasters/<script>.png".replace("<", "%3C"))
    assert answer.status == 404 and held.asked == []
    answer, body = ask(server, "/rasters/none.png?x=1")
    assert (answer.status, held.asked) == (404, ["rasters/none.png"])
    assert answer.getheader("Content-Type") == "text/plain; charset=utf-8"
    assert ask(server, "//etc/passwd")[0].status == 404  # Python takes one of the strokes away
    answer, body = ask(server, "/")
    assert answer.status == 404 and b"make viewer" in body


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "PROPFIND"])
def test_it_is_read_only(server: SiteServer, held: Held, method: str) -> None:
    answer, _ = ask(server, "/clouds/a.laz", method)
    assert (answer.status, answer.getheader("Allow"), held.asked) == (405, "GET, HEAD", [])


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "", "localhost.evil:{port}"]
)
def test_another_host_is_refused(server: SiteServer, held: Held, host: str) -> None:
    answer, body = ask(server, "/clouds/a.laz", headers={"Host": host.format(port=server.server_port)})
    assert (answer.status, held.asked) == (421, [])
    assert CONTENT[:9] not in body


def test_two_hosts_are_refused(server: SiteServer, held: Held) -> None:
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as stream:
        own = f"127.0.0.1:{server.server_port}"
        stream.sendall(f"GET /clouds/a.laz HTTP/1.1\r\nHost: {own}\r\nHost: evil.example\r\n\r\n".encode())
        assert b" 421 " in stream.recv(200)
    assert held.asked == []


def test_localhost_is_the_same(server: SiteServer) -> None:
    assert ask(server, "/clouds/a.laz", headers={"Host": f"localhost:{server.server_port}"})[0].status == 200


def test_heads_of_every_answer(server: SiteServer) -> None:
    for path in ("/clouds/a.laz", "/nothing", "/../x"):
        answer, _ = ask(server, path)
        policy = answer.getheader("Content-Security-Policy") or ""
        assert "default-src 'none'" in policy and "unsafe-inline" not in policy and "http" not in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.getheader("X-Content-Type-Options") == "nosniff"
        assert answer.getheader("Referrer-Policy") == "no-referrer"
        assert answer.getheader("Cross-Origin-Resource-Policy") == "same-origin"
        assert answer.getheader("Access-Control-Allow-Origin") is None
    policy = ask(server, "/report.html")[0].getheader("Content-Security-Policy") or ""
    assert "script-src" not in policy and "default-src 'none'" in policy


def test_it_listens_on_this_machine_alone(server: SiteServer) -> None:
    assert server.server_address[0] == "127.0.0.1"


def test_a_survey_is_shown_while_it_changes(finished: Simulated, tmp_path: Path) -> None:
    copy = finished.copy_with_store_to(tmp_path / "survey")
    site = LiveSite(open_survey(copy.survey_file))
    entry = site.document("survey.json")
    assert entry is not None and entry.file.is_relative_to(Path(copy.store().root) / "site")
    assert site.document("survey.json") == entry
    images = [f"rasters/hillshade/0/{p[0]}_{p[1]}.png" for p in places(site)]
    made = site.document(images[0])
    assert made is not None and made.file.read_bytes()[:4] == b"\x89PNG"
    assert site.document("rasters/hillshade/0/1_1.png") is None
    assert site.document("rasters/hillshade/99/1_1.png") is None
    assert site.document("nothing/at.all") is None
    again = LiveSite(open_survey(copy.survey_file))
    at = made.file.stat().st_mtime_ns
    kept = again.document(images[0])
    assert kept == made and kept.file.stat().st_mtime_ns == at  # not made anew
    material = site.material
    copy.run(products={"make": ["las"], "options": {}})
    changed = site.document("survey.json")
    assert changed is not None and site.material is not material


def places(site: LiveSite) -> list[list[int]]:
    """Column and row of the pictures of the finest level."""
    served = site.document("rasters/tiles_0.json")
    assert served is not None
    return [
        [c, row] for row, runs in json.loads(served.file.read_bytes())["rows"] for a, b in runs for c in range(a, b + 1)
    ]
