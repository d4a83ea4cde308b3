"""Remembers a request to end the program (Ctrl-C, or a system signal) until the program ends.

It is raised as :class:`Stopped`, but a library that was just calling back may raise another error instead
(lazrs does). So code that catches every error calls :func:`stop_if_asked` before it continues.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NoReturn


class Stopped(BaseException):
    """Raised where the program is interrupted by a request to end (Ctrl-C, or a system signal).

    Parameters
    ----------
    number : the signal's.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(number)


@dataclass(frozen=True)
class Request:
    """A signal that asks the program to end."""

    number: int
    """The signal's."""
    at_s: float
    """When it was received (s, monotonic)."""


_requests: list[Request] = []


def request() -> Request | None:
    """Return the request to end the program; None where there is none."""
    return _requests[0] if _requests else None


def stop(number: int) -> NoReturn:
    """Remember the request and raise :class:`Stopped`."""
    _requests.append(Request(number, time.monotonic()))
    raise Stopped(number)


def forget() -> None:
    """Forget the request, because it is about to be repeated."""
    _requests.clear()


def stop_if_asked() -> None:
    """Raise the request again if there is one.

    Raises
    ------
    Stopped
        in place of what a library made of it.
    """
    if _requests:
        raise Stopped(_requests[0].number) from None
