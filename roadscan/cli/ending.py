"""How the program ends: by itself, by an error that the user can mend, or because it was asked to."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

import typer

from roadscan.core import stopping
from roadscan.core.stopping import Stopped

_SIGNALS = ("SIGINT", "SIGTERM")
_NAMES = {"SIGINT": "Ctrl-C (SIGINT)", "SIGTERM": "the signal SIGTERM"}
_AGAIN_S = 0.05
"""When a request is repeated that Python could not hand on."""
_PATIENCE_S = 3.0
"""So long, what is begun may be tidied up; who asks once more after that is obeyed at once."""


def ending_well(command: Callable[[], Any]) -> None:
    """Run a command; an error that the user can mend, or a request to stop, ends it with one line and no traceback."""
    from roadscan.core.errors import RoadscanError, in_words
    from roadscan.core.private_folder import UnsafeFolderError

    _listen()
    try:
        command()
    except BrokenPipeError:  # who reads has seen enough, as `head` does
        _leave(1)
    except (RoadscanError, UnsafeFolderError) as error:
        _leave_if_asked()
        _fail(str(error))
    except OSError as error:
        _leave_if_asked()
        _fail(str(in_words(error)))
    except Stopped as stop:
        _leave_stopped(stop.number, getattr(stop, "__notes__", ()))
    except (Exception, SystemExit):
        _leave_if_asked()
        raise


def _fail(text: str) -> NoReturn:
    typer.secho(f"roadscan: {text}", err=True, fg=typer.colors.RED)
    raise SystemExit(2) from None


def _listen() -> None:
    """Raise :class:`Stopped` where a signal asks the program to end; one that is ignored (`nohup`) stays so."""
    for name in _SIGNALS:
        number = getattr(signal, name)
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)
    told = sys.unraisablehook

    def unraisable(what: Any) -> None:
        """A request that came while Python ran what may raise nothing (a finalizer) is made again soon."""
        asked = stopping.request()
        if asked is not None and issubclass(what.exc_type, Stopped):
            stopping.forget()
            threading.Timer(_AGAIN_S, os.kill, (os.getpid(), asked.number)).start()
        else:
            told(what)

    sys.unraisablehook = unraisable


def _stop(number: int, _frame: FrameType | None) -> None:
    asked = stopping.request()
    if asked is None:
        stopping.stop(number)
    if time.monotonic() - asked.at_s > _PATIENCE_S:
        _leave_stopped(number, ())


def _leave_if_asked() -> None:
    """A library may turn the request into an error of its own."""
    asked = stopping.request()
    if asked is not None:
        _leave_stopped(asked.number, ())


def _leave_stopped(number: int, notes: Any) -> NoReturn:
    name = _NAMES[signal.Signals(number).name]
    sys.stderr.write("; ".join([f"roadscan: stopped: {name}", *notes]) + "\n")
    _leave(128 + number)


def _leave(status: int) -> NoReturn:
    """End now: threads of workers and of libraries are not waited for, and say no more."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            continue
    os._exit(status)
