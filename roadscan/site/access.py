"""Who may see and edit a page that stands behind a proxy: the proxy tells who asks, a file says what they may.

roadscan asks nobody for a password: a proxy in front of it (oauth2-proxy, a web server with OIDC or LDAP) does, and
adds who asked as headers. A secret that only proxy and server know shows that a request came through the proxy.
"""

from __future__ import annotations

import hmac
import json
import os
import re
from email.message import Message
from pathlib import Path
from typing import Final, Literal, NamedTuple, Self
from urllib.parse import urlsplit

from roadscan.core.errors import ConfigError, in_words
from roadscan.core.gpstime import now_utc
from roadscan.core.strict import Strict, load_toml

SECRET_VARIABLE: Final = "ROADSCAN_PROXY_SECRET"
"""Environment variable with the secret that the proxy adds to each request."""
SECRET_HEADER: Final = "X-Roadscan-Proxy"
"""Header of the secret."""
_FEWEST_SECRET: Final = 24
"""Characters: a secret of random letters and digits of this length has more than 120 bits."""
_GROUP: Final = "group:"
_EVERYONE: Final = "*"
_NAME: Final = re.compile(r"[^\x00-\x1f\x7f,]{1,200}")
"""What a user's or a group's name may be: it becomes the author of edits."""

Role = Literal["viewer", "editor"]


class Asker(NamedTuple):
    """Who sent a request."""

    name: str
    """The user, as the proxy names them; empty for the person at this machine, and for the public."""
    role: Role
    """`viewer` sees the page, `editor` also changes inventory and control."""


def secret_of_proxy() -> str:
    """Return the secret that the proxy adds to each request, from the environment.

    Raises
    ------
    ConfigError
        where there is none, or one that can be guessed.
    """
    secret = os.environ.get(SECRET_VARIABLE, "")
    if len(secret) < _FEWEST_SECRET or not secret.isascii():
        raise ConfigError(
            f"the secret of the proxy has {len(secret)} characters",
            expected=f"at least {_FEWEST_SECRET} letters and digits in {SECRET_VARIABLE}",
            change="set it for this server, and let the proxy add it to each request as the header "
            f"{SECRET_HEADER} (`openssl rand -hex 24` makes one)",
        )
    return secret


class Access(Strict):
    """A file of access, for `roadscan view --access`."""

    address: str
    """Where people see the page: `https://roads.example.org`. The proxy leaves out what comes after the host."""
    listen: str = "127.0.0.1"
    """Address that the server listens on: a proxy on another host, or in a separate container, needs `0.0.0.0`."""
    user_header: str = "X-Forwarded-User"
    """Header in which the proxy says who asks."""
    groups_header: str = "X-Forwarded-Groups"
    """Header in which the proxy names the groups of who asks, with commas between them."""
    viewers: tuple[str, ...] = ()
    """Who sees the page: names of users, `group:NAME`, or `*` for everyone, also without a name. Editors do, too."""
    editors: tuple[str, ...] = ()
    """Who also edits: names of users and `group:NAME`."""
    audit: Path | None = None
    """File that gets a line of JSON for each document that somebody sends, taken or refused; relative to this file."""

    @classmethod
    def load(cls, file: Path) -> Self:
        """Return the access that a file describes.

        Raises
        ------
        ConfigError
            where the file or its address is wrong, or it names nobody, or everybody as editor.
        """
        access = cls.parse(load_toml(file), file=file)
        parts = urlsplit(access.address)
        if parts.scheme not in ("http", "https") or not parts.netloc or parts.username:
            raise ConfigError(f"address '{access.address}'", expected="one like https://roads.example.org", file=file)
        if not access.viewers and not access.editors:
            raise ConfigError(
                "nobody may see the page", change='name `editors` and `viewers`, or viewers = ["*"] for all', file=file
            )
        if _EVERYONE in access.editors:
            raise ConfigError(
                "everyone would be an editor, also without a name", expected="names or group:NAME", file=file
            )
        audit = None if access.audit is None else (file.parent / access.audit).resolve()
        return access.model_copy(update={"audit": audit})

    @property
    def origin(self) -> str:
        """Return the origin of the page (RFC 6454), as browsers send it with what people post."""
        parts = urlsplit(self.address)
        return f"{parts.scheme}://{parts.netloc}"

    def asker(self, headers: Message, secret: str) -> Asker | None:
        """Return who sent a request; None for one that did not come through the proxy, or of someone without a role."""
        values = [headers.get_all(one, [""]) for one in (SECRET_HEADER, self.user_header, self.groups_header)]
        if any(len(one) != 1 for one in values):  # A proxy that adds a header has left that of the browser beside it.
            return None
        given, name, named_groups = (one[0].strip() for one in values)
        if not hmac.compare_digest(given.encode("utf-8", "replace"), secret.encode()):
            return None
        if name and (_NAME.fullmatch(name) is None or name.startswith(_GROUP) or name == _EVERYONE):
            return None
        groups = [one.strip() for one in named_groups.split(",")]
        known = {name, *(f"{_GROUP}{one}" for one in groups if one)} - {""}
        if name and known & set(self.editors):
            return Asker(name, "editor")
        return Asker(name, "viewer") if {_EVERYONE, *known} & set(self.viewers) else None

    def note(self, asker: Asker | None, path: str, outcome: str) -> None:
        """Add a line to the audit, where one is kept.

        Raises
        ------
        RoadscanError
            where it cannot be written: then nothing is taken either.
        """
        if self.audit is None:
            return
        name, role = ("", "none") if asker is None else asker
        at = now_utc("milliseconds")
        line = json.dumps({"at": at, "who": name, "role": role, "path": path, "outcome": outcome}, ensure_ascii=False)
        try:
            with self.audit.open("ab", buffering=0) as stream:  # one write a line: lines of two servers do not mix
                stream.write(f"{line}\n".encode())
        except OSError as error:
            raise in_words(error) from error
