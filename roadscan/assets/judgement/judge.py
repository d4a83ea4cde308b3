"""A judge: boosted trees that turn the features of a segment into the probability of what it is.

The trees are fitted outside of the library (`benchmarks/judgement.py`) and shipped as a text file beside this one, with
the record of their training. Nothing but NumPy and a kernel is needed to ask them, and the sum is taken in the order of
the trees, so the same features give the same bits on each machine.

The file is part of what a result depends on, but no code: who asks names its digest, and another file is refused.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roadscan.assets.kernels.boosted_trees import tree_sums
from roadscan.compute.array_types import Bool, Float64
from roadscan.core.errors import RoadscanError

FOLDER: Final = Path(__file__).parent / "models"
_MOST_ODDS: Final = 9.2
"""Greatest logarithm of the odds that is stated: 0.9999. No fit to a few thousand segments can say more."""


class Trees(NamedTuple):
    """Nodes (m,) of all trees, as :func:`roadscan.assets.kernels.boosted_trees.tree_sums` reads them."""

    starts: npt.NDArray[np.int32]
    feature: npt.NDArray[np.int32]
    threshold: Float64
    left: npt.NDArray[np.int32]
    right: npt.NDArray[np.int32]
    missing_left: Bool
    value: Float64


@dataclass(frozen=True, eq=False)
class Model:
    """What a file of trees states."""

    features: tuple[str, ...]
    """Names of the features, in the order of the columns."""
    trees: Trees
    offset: float
    slope: float
    """Logarithm of the stated odds = offset + slope · sum of the leaves (Platt 1999), fitted to segments that the trees
    have not seen."""
    record: Mapping[str, Any]
    """Of its training: data, seeds, versions, and how well it did on what it had not seen."""


@dataclass(frozen=True)
class Judge:
    """One question about segments, and the file that answers it."""

    name: str
    digest: str
    """First 16 hexadecimal digits of the SHA-256 of the file: results depend on it, so it is named in the code."""

    def of_each(self, segments: Sequence[Mapping[str, float]]) -> Float64:
        """Returns the same (n,) of segments whose features are told one by one; none of none."""
        names = segments[0] if segments else ()
        told = {name: [one[name] for one in segments] for name in names}
        return self.probability(told) if told else np.empty(0)

    def probability(self, features: Mapping[str, npt.ArrayLike]) -> Float64:
        """Returns the probability (n,) that each segment is what the question asks for.

        features : values (n,) by name, NaN where one is not known. All that the model asks for have to be there.
        """
        model = model_of(self)
        rows = np.column_stack([np.asarray(features[name], np.float64) for name in model.features])
        sums = np.empty(len(rows))
        tree_sums(np.ascontiguousarray(rows), *model.trees, sums)
        # math.exp and not numpy.exp: the latter differs in the last bit between processors.
        odds = np.clip(model.offset + model.slope * sums, -_MOST_ODDS, _MOST_ODDS)
        return np.array([1.0 / (1.0 + math.exp(-o)) for o in odds.tolist()])


@functools.cache
def model_of(judge: Judge) -> Model:
    """Returns the model of a judge.

    Raises
    ------
    RoadscanError
        where its file is missing or is not the one that was named.
    """
    return parsed(stated_by(FOLDER / f"{judge.name}.json", judge.digest, f"the judge '{judge.name}'"))


def stated_by(file: Path, digest: str, what: str) -> Any:
    """Returns the content of a file of a fit.

    Raises
    ------
    RoadscanError
        where it is missing or has another digest than the code names.
    """
    content = file.read_bytes() if file.is_file() else b""
    found = hashlib.sha256(content).hexdigest()[:16]
    if found != digest:
        raise RoadscanError(
            f"{what} is not the one that this version was made with: its file has the digest {found}, not {digest}",
            expected="a whole installation: install roadscan again",
        )
    return json.loads(content)


def parsed(stated: Mapping[str, Any]) -> Model:
    """Returns the model that the content of a file states."""
    starts, parts = [], []
    first = 0
    for tree in stated["trees"]:
        starts.append(first)
        nodes = _nodes(tree, first)
        first += len(nodes[0])
        parts.append(nodes)
    columns = [np.concatenate([part[k] for part in parts]) for k in range(6)]
    trees = Trees(np.array(starts, np.int32), *columns)
    return Model(tuple(stated["features"]), trees, stated["offset"], stated["slope"], stated["record"])


def _nodes(tree: Mapping[str, Sequence[Any]], first: int) -> tuple[npt.NDArray[Any], ...]:
    """Returns the nodes of a tree, whose numbers begin with `first`."""
    feature = np.array(tree["feature"], np.int32)
    left, right = (np.where(feature >= 0, np.array(tree[k], np.int32) + first, -1).astype(np.int32)
                   for k in ("left", "right"))  # fmt: skip
    threshold, value = (np.array(tree[k], np.float64) for k in ("threshold", "value"))
    return feature, threshold, left, right, np.array(tree["missing_left"], np.bool_), value
