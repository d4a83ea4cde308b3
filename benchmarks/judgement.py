"""Fitting of judges (`roadscan/assets/judgement`): gradient boosting with groups held out, then one file a question.

A question is a file beside this one, `judge_<name>.py`, with a function `segments(folder)` that yields the segments of
each street with what they are. ``python -m benchmarks.judgement NAME`` fits the trees, writes
`roadscan/assets/judgement/models/NAME.json` and prints the digest that the code has to name. A file with `TYPES` yields
the type of each segment instead, and a judge is fitted to each of these; its function `asked`, where it has one, turns
types into the answers. Streets are the groups:
figures of the record are those of streets, and of parts of a recorded street, that the trees had not seen.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import lightgbm
import numpy as np
import numpy.typing as npt
import scipy.optimize

from benchmarks.asset_scores import error_of_stated
from benchmarks.settings import bench_folder
from roadscan.assets.judgement.judge import FOLDER

Float64 = npt.NDArray[np.float64]

FOLDS: Final = 5
_TREES: Final = {
    "objective": "binary", "num_leaves": 8, "learning_rate": 0.06, "min_data_in_leaf": 15, "lambda_l2": 5.0,
    "feature_fraction": 0.7, "bagging_fraction": 0.8, "bagging_freq": 1, "max_bin": 63, "deterministic": True,
    "force_row_wise": True, "num_threads": 1, "seed": 1, "verbosity": -1,
}  # fmt: skip
"""Few leaves and strong shrinkage: segments are thousands, streets are tens."""
_ROUNDS: Final = 120
_DIGITS: Final = 6
"""Significant digits of thresholds and leaves in the file."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of one street, or of one part of a recorded street."""

    group: str | npt.NDArray[np.str_]
    """Segments of one group are held out together: that of the street, or of each segment (n,)."""
    source: str
    """Such as "simulated" or the recording's name."""
    features: dict[str, Float64]
    """(n,) by name."""
    true: npt.NDArray[Any]
    """(n,) what they are: whether the answer is yes, or a type."""
    weight: Float64
    """(n,) how much each counts."""


def with_unknown(segments: Iterable[Segments], names: Sequence[str], share: float = 0.3) -> Iterator[Segments]:
    """Segments, and each again with a share of its weight and without some features: not all data tell them."""
    for one in segments:
        unknown = {name: np.full(len(one.true), np.nan) for name in names}
        yield one
        yield replace(one, features=one.features | unknown, weight=share * one.weight)


def fit(segments: Iterable[Segments], *, increasing: Sequence[str] = (), decreasing: Sequence[str] = (),
        **changed: Any) -> dict[str, Any]:  # fmt: skip
    """The content of the file of a judge.

    increasing, decreasing : features of which more never makes it less (more) probable. changed : settings of LightGBM.
    """
    held = list(segments)
    names = list(held[0].features)
    rows = np.concatenate([np.column_stack([one.features[n] for n in names]) for one in held])
    true, weight = (np.concatenate([getattr(one, k) for one in held]) for k in ("true", "weight"))
    group = np.concatenate([np.broadcast_to(one.group, len(one.true)) for one in held])
    source = np.repeat([one.source for one in held], [len(one.true) for one in held])
    signs = [(n in increasing) - (n in decreasing) for n in names]
    settings = {**_TREES, "monotone_constraints": signs, **changed}
    rounds = int(settings.pop("rounds", _ROUNDS))
    outside = held_out_sums(rows, true, weight, group, settings, rounds)
    offset, slope = platt(outside, true, weight)
    booster = lightgbm.train(settings, lightgbm.Dataset(rows, true, weight=weight), rounds)
    return {
        "features": names,
        "offset": _short(offset), "slope": _short(slope),
        "record": {
            "lightgbm": lightgbm.__version__, "settings": settings, "rounds": rounds,
            "streets": {one: sorted(set(group[source == one].tolist())) for one in sorted(set(source))},
            "held out": {
                one: _figures(offset + slope * outside[source == one], true[source == one])
                for one in sorted(set(source))
            },
        },
        "trees": [_tree(one["tree_structure"]) for one in booster.dump_model()["tree_info"]],
    }  # fmt: skip


def held_out_sums(
    rows: Float64, true: npt.NDArray[np.bool_], weight: Float64, group: npt.NDArray[Any], settings: dict[str, Any],
    rounds: int,
) -> Float64:  # fmt: skip
    """Sums of the leaves (n,) of each segment by trees that saw no segment of its group."""
    numbers = {g: k % FOLDS for k, g in enumerate(sorted(set(group), key=_digest))}
    fold = np.array([numbers[g] for g in group])
    out = np.zeros(len(true))
    for k in range(min(FOLDS, len(numbers))):
        seen = fold != k
        booster = lightgbm.train(settings, lightgbm.Dataset(rows[seen], true[seen], weight=weight[seen]), rounds)
        out[~seen] = booster.predict(rows[~seen], raw_score=True)
    return out


def platt(sums: Float64, true: npt.NDArray[np.bool_], weight: Float64) -> tuple[float, float]:
    """Offset and slope of the logarithm of the odds (Platt 1999) that make the observed most likely."""

    def cost(x: Float64) -> float:
        odds = x[0] + x[1] * sums
        return float(np.average(np.logaddexp(0.0, np.where(true, -odds, odds)), weights=weight))

    offset, slope = scipy.optimize.minimize(cost, np.array([0.0, 1.0]), method="Nelder-Mead").x
    return float(offset), float(slope)


def _figures(odds: Float64, true: npt.NDArray[np.bool_]) -> dict[str, float]:
    stated = 1.0 / (1.0 + np.exp(-odds))
    found = stated >= 0.5
    return {
        "segments": len(true), "true": int(true.sum()),
        "recall": round(float((found & true).sum() / max(int(true.sum()), 1)), 4),
        "precision": round(float((found & true).sum() / max(int(found.sum()), 1)), 4),
        "calibration error": round(error_of_stated(stated, true), 4),
    }  # fmt: skip


def _tree(root: dict[str, Any]) -> dict[str, list[Any]]:
    """Nodes of a tree in the order of a walk, the root first."""
    out: dict[str, list[Any]] = {k: [] for k in ("feature", "threshold", "left", "right", "missing_left", "value")}

    def walk(node: dict[str, Any]) -> int:
        number = len(out["feature"])
        leaf = "leaf_value" in node
        for name, own in (
            ("feature", -1 if leaf else node["split_feature"]),
            ("threshold", 0.0 if leaf else _short(node["threshold"])),
            ("left", -1), ("right", -1),
            # what is not known counts as 0 where no segment of the training lacked that feature
            ("missing_left", False if leaf else bool(
                node["default_left"] if node["missing_type"] == "NaN" else node["threshold"] >= 0.0)),
            ("value", _short(node["leaf_value"]) if leaf else 0.0),
        ):  # fmt: skip
            out[name].append(own)
        if not leaf:
            out["left"][number] = walk(node["left_child"])
            out["right"][number] = walk(node["right_child"])
        return number

    walk(root)
    return out


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _digest(text: str) -> str:
    return hashlib.blake2b(str(text).encode(), digest_size=8).hexdigest()


def written(name: str, content: dict[str, Any], folder: Path = FOLDER) -> str:
    """Write the file of a judge; returns the digest that the code has to name."""
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
    text = text.replace('"trees":[{', '"trees":[\n{').replace("},{", "},\n{") + "\n"
    (folder / f"{name}.json").write_text(text, encoding="utf-8")
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _asked(question: ModuleType, some: Segments, kind: str) -> Segments:
    """Segments with the answers to one of the questions of a file."""
    if hasattr(question, "asked"):
        return question.asked(some, kind)  # type: ignore[no-any-return]
    return replace(some, true=some.true == kind) if hasattr(question, "TYPES") else some


def main() -> None:
    """Fit the judge of a question."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.judgement", description="Fit the judge of a question.")
    parser.add_argument("name")
    name = parser.parse_args().name
    question = importlib.import_module(f"benchmarks.judge_{name}")
    with tempfile.TemporaryDirectory() as scratch:
        segments = list(question.segments(bench_folder(Path(scratch))))
    for one in getattr(question, "TYPES", (name,)):
        asked = [_asked(question, s, one) for s in segments]
        content = fit(asked, **getattr(question, "FIT", {}))
        print(json.dumps(content["record"], indent=1, ensure_ascii=False))
        print(f'Judge("{one}", "{written(one, content)}")')


if __name__ == "__main__":
    main()
