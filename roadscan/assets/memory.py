"""Cache of results for one scene that several kinds need."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from roadscan.assets.scene import Scene

Found = TypeVar("Found")
Options = ParamSpec("Options")

_Find = Callable[Concatenate[Scene, Options], Found]


def once_a_tile(find: _Find[Options, Found]) -> _Find[Options, Found]:
    """Returns the same function, which processes a scene once while the scene is in memory."""
    known: weakref.WeakKeyDictionary[Scene, dict[object, Found]] = weakref.WeakKeyDictionary()

    @functools.wraps(find)
    def remembered(scene: Scene, *options: Options.args, **named: Options.kwargs) -> Found:
        found = known.setdefault(scene, {})
        if options not in found:
            found[options] = find(scene, *options, **named)
        return found[options]

    return remembered


def once_a_scene(find: _Find[Options, Found]) -> _Find[Options, Found]:
    """Returns the same function, which processes a scene of several tiles once, for all of them together."""
    remembered = once_a_tile(find)

    @functools.wraps(find)
    def of_whole(scene: Scene, *options: Options.args, **named: Options.kwargs) -> Found:
        return remembered(scene if scene.whole is None else scene.whole, *options, **named)

    return of_whole
