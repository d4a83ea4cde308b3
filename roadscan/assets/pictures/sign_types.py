"""Types of signs: a small net on features of faces, which ships with roadscan and says what it does not know.

It was fitted to rendered drawings of common signs of the Vienna Convention and of the MUTCD, beside plates that are
none of these (`benchmarks/fit_sign_types.py`). Its weights, and all that they are multiplied with, are whole numbers,
whose sums are exact in any order: the same cut-outs give the same bits on each processor.
"""

from __future__ import annotations

import base64
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.assets.judgement.judge import stated_by
from roadscan.assets.pictures.reader import CutOut
from roadscan.assets.pictures.sign_features import box_px, features_of
from roadscan.compute.array_types import Float64

UNKNOWN: Final = "unknown"
"""Type of a plate that pictures show and that is no listed type for sure."""
FILE: Final = Path(__file__).parent / "models" / "sign_types.json"
DIGEST: Final = "8d24234ead81adba"
"""First 16 hexadecimal digits of the SHA-256 of the file."""
MOST_HIDDEN: Final = 4095  # Greatest value of a unit of the hidden layer.
LEAST_PX: Final = 10.0  # Smaller plates (pixels) are not looked at; the fit saw none below 12.
_OTHER_SET: Final = math.log(50.0)
"""Where a survey names its set of signs, those of the other set are this much (logarithm of the odds) less probable."""


@dataclass(frozen=True, eq=False)
class Layer:
    """A layer of whole weights (inputs, outputs), with a factor and an offset for each output."""

    weights: Float64
    factor: Float64
    offset: Float64

    def of(self, values: Float64) -> Float64:
        """Returns its outputs for whole numbers (n, inputs)."""
        return np.asarray((values @ self.weights) * self.factor + self.offset)


@dataclass(frozen=True, eq=False)
class SignTypes:
    """What the file of the recogniser states."""

    codes: tuple[tuple[str, ...], ...]
    """Codes of each type: a face that both sets show alike has one of each."""
    layers: tuple[Layer, Layer]
    threshold: float
    """Least probability of a type that is stated."""
    record: Mapping[str, Any]
    """Of the fit: seeds, versions, and how well it did on plates that it had not seen."""

    def odds(self, features: npt.NDArray[np.uint8]) -> Float64:
        """Returns logarithms of weights (k, types + 1) of the types of k plates; the last is of no listed type.

        features : (k, COUNT), of :func:`roadscan.assets.pictures.sign_features.features_of`.
        """
        hidden = np.clip(np.rint(self.layers[0].of(features.astype(np.float64))), 0.0, MOST_HIDDEN)
        return self.layers[1].of(hidden)

    def type_of(self, cut_outs: Sequence[CutOut], signs: str) -> tuple[str, float | None]:
        """Returns the code of a plate's type and its probability; `unknown` without one where none is probable enough.

        Cut-outs vote: the logarithms of their weights are averaged, each by the size of the plate in it.

        signs : "vienna" or "mutcd", the set that the country has, or "both".
        """
        large = [one for one in cut_outs if min(box_px(one)) >= LEAST_PX]
        if not large:
            return UNKNOWN, None
        sizes_px = [min(box_px(one)) for one in large]
        return self.voted(self.odds(np.array([features_of(one) for one in large])), sizes_px, signs)

    def voted(self, odds: Float64, sizes_px: Sequence[float], signs: str) -> tuple[str, float | None]:
        """Returns the answer of :meth:`type_of` from odds (k, types + 1) of plates of these sizes (pixels)."""
        whole = math.fsum(sizes_px)
        own = [self._code(codes, signs) for codes in self.codes]
        joined = [math.fsum(size * value for size, value in zip(sizes_px, column, strict=True)) / whole
                  for column in odds.T.tolist()]  # fmt: skip
        joined = [value - (_OTHER_SET if k < len(own) and not own[k] else 0.0) for k, value in enumerate(joined)]
        top = max(joined)
        weights = [math.exp(value - top) for value in joined]
        best = max(range(len(own)), key=lambda k: weights[k])
        probability = weights[best] / math.fsum(weights)
        return (own[best], probability) if own[best] and probability >= self.threshold else (UNKNOWN, None)

    @staticmethod
    def _code(codes: Sequence[str], signs: str) -> str:
        return " ".join(code for code in codes if signs == "both" or code.startswith(f"{signs}:"))


@functools.cache
def sign_types() -> SignTypes:
    """Returns the recogniser; raises as :func:`roadscan.assets.judgement.judge.stated_by`."""
    return made_of(stated_by(FILE, DIGEST, "the recogniser of signs"))


def made_of(stated: Mapping[str, Any]) -> SignTypes:
    """Returns the recogniser that the content of a file states."""
    codes = tuple(tuple(one["codes"]) for one in stated["types"])
    layers = layer_of(stated["hidden"]), layer_of(stated["out"])
    return SignTypes(codes, layers, stated["threshold"], stated["record"])


def listed_types() -> Sequence[Mapping[str, Any]]:
    """Returns the list of types: codes, name, shape and colours of each."""
    return tuple(stated_by(FILE, DIGEST, "the recogniser of signs")["types"])


def layer_of(stated: Mapping[str, Any]) -> Layer:
    """Returns a layer as the file states it: weights of eight bits in base64, by input then output."""
    factor, offset = (np.array(stated[name], np.float64) for name in ("factor", "offset"))
    weights = np.frombuffer(base64.b64decode(stated["weights"]), np.int8).reshape(-1, factor.size)
    return Layer(weights.astype(np.float64), factor, offset)
