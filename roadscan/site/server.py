"""A local server that only gives the documents of a site to a browser on the same machine.

It listens on a loopback address. It answers GET and HEAD, whole or by one range (RFC 9110, 14), for paths that the site
names; no path reaches the file system. A request that names another host is refused, so that no page of another origin
reads the survey by a name that resolves to this machine. Where it has doors, it answers POST from its page: what
changes nothing as it is, and what writes with a token that stands in no document. Behind a proxy (`access.py`), it
answers only those whom the file of access names.
"""

from __future__ import annotations

import hmac
import re
import secrets
import sys
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Protocol
from urllib.parse import unquote, urlsplit

from roadscan import __version__
from roadscan.core.errors import RoadscanError
from roadscan.site.access import Access, Asker, secret_of_proxy
from roadscan.site.document import json_bytes
from roadscan.site.live import Served
from roadscan.site.site import REPORT_PAGE
from roadscan.site.web_part import HOW_TO_BUILD, PAGE

LOOPBACK: Final = "127.0.0.1"

POLICY: Final = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; style-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self' data: blob:; font-src 'self'; manifest-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page: it runs and loads only what this server gives."""
_REPORT_POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Policy of the report, which has no script; its style and its pictures are inline."""

_TYPES: Final = {
    ".css": "text/css; charset=utf-8", ".fgb": "application/vnd.flatgeobuf",
    ".glb": "model/gltf-binary", ".html": "text/html; charset=utf-8",
    ".ico": "image/x-icon", ".jpg": "image/jpeg", ".js": "text/javascript; charset=utf-8",
    ".json": "application/json; charset=utf-8", ".laz": "application/octet-stream",
    ".mjs": "text/javascript; charset=utf-8",
    ".parquet": "application/octet-stream", ".png": "image/png", ".svg": "image/svg+xml", ".tif": "image/tiff",
    ".txt": "text/plain; charset=utf-8", ".vpc": "application/json; charset=utf-8", ".vrt": "application/xml",
    ".wasm": "application/wasm", ".webmanifest": "application/manifest+json", ".webp": "image/webp",
    ".woff2": "font/woff2",
}  # fmt: skip
_PATH: Final = re.compile(r"/([A-Za-z0-9_-][A-Za-z0-9_.-]*(?:/[A-Za-z0-9_-][A-Za-z0-9_.-]*)*)?")
_RANGE: Final = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_LONGEST_HEAD: Final = 8192  # longer paths are refused
EDIT: Final = "/edit"
"""Where an editor behind a proxy asks for the page that edits."""
TOKEN_HEADER: Final = "X-Roadscan-Edit"
"""Header with the token, which a page of another origin can only send with this server's permission."""
_MOST_POSTED_BYTES: Final = 16_000_000  # larger documents are refused
_POSTED: Final = ("application/geo+json", "application/json")
"""Types of documents that are taken: a page of another origin cannot send them without this server's permission."""


class Documents(Protocol):
    """Source of documents."""

    def document(self, path: str) -> Served | None:
        """Return a document by its path; None where there is none."""


class Door(NamedTuple):
    """What answers documents that the page posts at a path."""

    answer: Callable[[bytes, str], Any]
    """Takes a document and who sent it: "" for the person at this machine."""
    writes: bool
    """Whether it changes files: the token is asked for."""


class SiteServer(ThreadingHTTPServer):
    """Serves a site on a loopback port; a context manager, in which `serve_forever` answers until `shutdown`."""

    daemon_threads = True
    allow_reuse_address = False

    def __init__(
        self, documents: Documents, port: int = 0, doors: Mapping[str, Door] | None = None,
        access: Access | None = None,
    ) -> None:  # fmt: skip
        """Listen on a port; 0 selects a free one. Doors are named by their paths; a page behind a proxy has access."""
        self.documents, self.doors, self.access = documents, doors or {}, access
        self.secret = "" if access is None else secret_of_proxy()
        self.token = secrets.token_urlsafe(24) if any(door.writes for door in self.doors.values()) else ""
        super().__init__((LOOPBACK if access is None else access.listen, port), _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a browser that closed the connection early; report all other errors."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]

    @property
    def address(self) -> str:
        """Address of the page with the token of edits after `#`, which browsers send to no server."""
        if self.access is not None:
            return self.access.address  # editors get their token there
        return f"http://{LOOPBACK}:{self.server_port}/" + (f"#edit={self.token}" if self.token else "")

    @property
    def hosts(self) -> frozenset[str]:
        """Host names that requests may use where no proxy stands before the server."""
        return frozenset(f"{name}:{self.server_port}" for name in (LOOPBACK, "localhost"))


class _Handler(BaseHTTPRequestHandler):
    server: SiteServer
    protocol_version = "HTTP/1.1"
    server_version = f"roadscan/{__version__}"
    sys_version = ""
    timeout = 60

    def do_GET(self) -> None:
        """Answer with a document or a part of it; an editor who asks for `/edit` is sent to the page that edits."""
        if self.server.access is not None and self.path == EDIT and (asker := self._asker()) and asker.role == "editor":
            self._head(HTTPStatus.SEE_OTHER, "", {"Location": f"/#edit={self.server.token}", "Content-Length": "0"})
            return
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Answer with the header only."""
        self._answer(with_body=False)

    def do_POST(self) -> None:
        """Answer by a door."""
        self.close_connection = True  # an unread body may follow
        door = self.server.doors.get(urlsplit(self.path).path.removeprefix("/"))
        if door is None:
            self._refuse_method()
            return
        asker = self._asker()
        refused = self._refused(door, asker)
        try:
            self._note(door, asker, "received" if refused is None else f"refused: {refused[1]}")
        except RoadscanError as error:
            self._text(HTTPStatus.INTERNAL_SERVER_ERROR, f"the audit cannot be kept: {error}")
            return
        if refused is not None:
            self._text(*refused)
            return
        content = self.rfile.read(int(self.headers["Content-Length"]))
        try:
            answer = door.answer(content, asker.name if asker else "")
        except RoadscanError as error:
            self._told(door, asker, f"refused: {error}")
            self._text(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
            return
        commit = answer.get("commit")
        self._told(door, asker, "taken" if commit is None else f"taken: commit {commit}")
        body = json_bytes(answer)
        self._head(HTTPStatus.OK, "answer.json", {"Content-Length": str(len(body))})
        self.wfile.write(body)

    def _asker(self) -> Asker | None:
        """Return who asks; None where they may see nothing. Without a proxy it is the person at this machine."""
        if self.server.access is None:
            named = self.headers.get_all("Host", []) in [[host] for host in self.server.hosts]
            return Asker("", "editor") if named else None
        return self.server.access.asker(self.headers, self.server.secret)

    def _note(self, door: Door, asker: Asker | None, outcome: str) -> None:
        """Tell the audit of a document that is to change files; RoadscanError where it cannot be written."""
        if door.writes and self.server.access is not None:
            self.server.access.note(asker, self.path, outcome)

    def _told(self, door: Door, asker: Asker | None, outcome: str) -> None:
        """Tell the audit what became of a document, and standard error where the audit cannot be written any more."""
        try:
            self._note(door, asker, outcome)
        except RoadscanError as error:
            sys.stderr.write(f"roadscan: the audit cannot be kept: {error}; {outcome}\n")

    def _refused(self, door: Door, asker: Asker | None) -> tuple[HTTPStatus, str] | None:
        """Return why a document is refused; None where it comes from this server's page."""
        access = self.server.access
        origin = f"http://{self.headers.get('Host', '')}" if access is None else access.origin
        if asker is None or self.headers.get_all("Origin", []) != [origin]:
            return HTTPStatus.FORBIDDEN, "documents are taken from this server's own page alone"
        if door.writes and asker.role != "editor":
            return HTTPStatus.FORBIDDEN, f"'{asker.name}' may look at this page, and not edit it"
        token = self.headers.get(TOKEN_HEADER, "").encode("utf-8", "replace")
        if door.writes and not hmac.compare_digest(token, self.server.token.encode()):
            return (
                HTTPStatus.FORBIDDEN,
                f"open the page by the address that roadscan printed, or by {EDIT}: it allows edits",
            )
        if self.headers.get_content_type() not in _POSTED:
            return HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"documents come as {' or '.join(_POSTED)}"
        length = self.headers.get("Content-Length", "")
        if not length.isascii() or not length.isdigit():
            return HTTPStatus.LENGTH_REQUIRED, "documents come with their length"
        if int(length) > _MOST_POSTED_BYTES:
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a document holds {_MOST_POSTED_BYTES} bytes at most"
        return None

    def __getattr__(self, name: str) -> object:
        if name.startswith("do_"):
            return self._refuse_method
        raise AttributeError(name)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  as the base class has it
        """Suppress the log of requests."""

    def _refuse_method(self) -> None:
        self.close_connection = True  # an unread body may follow
        words = "documents are taken at their addresses alone" if self.server.doors else "this server is read-only"
        self._text(HTTPStatus.METHOD_NOT_ALLOWED, words, {"Allow": "GET, HEAD"})

    def _answer(self, *, with_body: bool) -> None:
        if self._asker() is None:
            refusal = (HTTPStatus.MISDIRECTED_REQUEST, "ask for the address that roadscan printed")
            if self.server.access is not None:
                refusal = (HTTPStatus.FORBIDDEN, "the file of access does not name you, or this is not the proxy's way")
            self._text(*refusal, with_body=with_body)
            return
        path = unquote(urlsplit(self.path).path, errors="replace") if len(self.path) < _LONGEST_HEAD else ""
        found = _PATH.fullmatch(path)
        if found is None:
            self._text(HTTPStatus.NOT_FOUND, "there is no such document", with_body=with_body)
            return
        name = found[1] or PAGE
        try:
            served = self.server.documents.document(name)
        except RoadscanError as error:
            self._text(HTTPStatus.INTERNAL_SERVER_ERROR, str(error), with_body=with_body)
            return
        if served is None:
            missing = f"the page was not built: {HOW_TO_BUILD}" if name == PAGE else "there is no such document"
            self._text(HTTPStatus.NOT_FOUND, missing, with_body=with_body)
            return
        self._send(name, served, with_body=with_body)

    def _send(self, name: str, served: Served, *, with_body: bool) -> None:
        tag = f'"{served.key}"'
        if tag in [one.strip() for one in self.headers.get("If-None-Match", "").split(",")]:
            self._head(HTTPStatus.NOT_MODIFIED, name, {"ETag": tag})
            return
        with served.file.open("rb") as stream:
            size = stream.seek(0, 2)
            asked = self.headers.get("Range") if self.headers.get("If-Range", tag) == tag else None
            span = None if asked is None else range_of(asked, size)
            if span is not None and not span:
                self._text(
                    HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, "the document is shorter",
                    {"Content-Range": f"bytes */{size}"}, with_body=with_body,
                )  # fmt: skip
                return
            headers = {
                "ETag": tag,
                "Accept-Ranges": "bytes",
                "Content-Length": str(size if span is None else len(span)),
            }
            if span is not None:
                headers["Content-Range"] = f"bytes {span.start}-{span.stop - 1}/{size}"
            self._head(HTTPStatus.OK if span is None else HTTPStatus.PARTIAL_CONTENT, name, headers)
            if with_body:
                self._copy(stream, range(size) if span is None else span)

    def _copy(self, stream: BinaryIO, span: range) -> None:
        stream.seek(span.start)
        left = len(span)
        while left:
            piece = stream.read(min(left, 1 << 20))
            if not piece:
                self.close_connection = True  # the file was truncated meanwhile: the promised length is impossible
                return
            self.wfile.write(piece)
            left -= len(piece)

    def _text(
        self, status: HTTPStatus, text: str, further: dict[str, str] | None = None, *, with_body: bool = True
    ) -> None:
        content = f"{text}\n".encode()
        self._head(status, "message.txt", {"Content-Length": str(len(content)), **(further or {})})
        if with_body:
            self.wfile.write(content)

    def _head(self, status: HTTPStatus, name: str, further: dict[str, str]) -> None:
        self.send_response(status)
        self.send_header("Content-Type", _TYPES.get(Path(name).suffix, "application/octet-stream"))
        self.send_header("Content-Security-Policy", _REPORT_POLICY if name == REPORT_PAGE else POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cache-Control", "no-cache")
        for header, value in further.items():
            self.send_header(header, value)
        self.end_headers()


def range_of(asked: str, size: int) -> range | None:
    """Return the bytes of a document that a ``Range`` header requests; empty where the document has none of them.

    None where the whole document is to be sent: for another unit, several ranges, or what is no range.
    """
    found = _RANGE.fullmatch(asked.strip())
    if found is None or not (found[1] or found[2]):
        return None
    if not found[1]:
        return range(max(0, size - int(found[2])), size)
    first, last = int(found[1]), int(found[2]) if found[2] else size - 1
    if found[2] and last < first:
        return None
    return range(first, min(last + 1, size)) if first < size else range(0)
