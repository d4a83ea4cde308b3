"""Cache of results for one scene that several kinds need."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import TypeVar

from roadscan.assets.scene import Scene

Found = TypeVar("Found")


def once_a_scene(find: Callable[[Scene], Found]) -> Callable[[Scene], Found]:
    """Returns the same function, which processes a scene once while the scene is in memory."""
    known: weakref.WeakKeyDictionary[Scene, Found] = weakref.WeakKeyDictionary()

    @functools.wraps(find)
    def remembered(scene: Scene) -> Found:
        if scene not in known:
            known[scene] = find(scene)
        return known[scene]

    return remembered
