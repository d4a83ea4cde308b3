"""Cache of results for one scene that several kinds need."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import Any, TypeVar, cast

from roadscan.assets.scene import Scene

Find = TypeVar("Find", bound=Callable[..., Any])


def once_a_tile(find: Find) -> Find:
    """Returns the same function of a scene and options, which is computed once while the scene is in memory."""
    known: weakref.WeakKeyDictionary[Scene, dict[object, Any]] = weakref.WeakKeyDictionary()

    @functools.wraps(find)
    def remembered(scene: Scene, *options: object) -> Any:
        found = known.setdefault(scene, {})
        if options not in found:
            found[options] = find(scene, *options)
        return found[options]

    return cast(Find, remembered)


def once_a_scene(find: Find) -> Find:
    """Returns the same function, which is computed once for all tiles of a scene together."""
    remembered = once_a_tile(find)

    @functools.wraps(find)
    def of_whole(scene: Scene, *options: object) -> Any:
        return remembered(scene if scene.whole is None else scene.whole, *options)

    return cast(Find, of_whole)
