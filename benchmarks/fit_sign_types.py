"""Fit of the recogniser of sign types (`roadscan/assets/pictures/sign_types.py`) to rendered plates.

``python -m benchmarks.fit_sign_types --folder DIR`` renders plates (`sign_renders.py`), fits a net of one hidden layer
to their features, finds the threshold on plates of no listed type that the fit has not seen, writes
`roadscan/assets/pictures/models/sign_types.json` with the record, and prints the digest that the code has to name.
No picture of others is used. Features are kept in DIR; the same seeds give the same file.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import itertools
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.sign_faces import FACES
from benchmarks.sign_renders import HELD_OUT, MORE, SIZES_PX, UNLISTED, face_drawing, seen, size_by_chance
from roadscan.assets.pictures.sign_types import COUNT, FILE, MOST_HIDDEN, UNKNOWN, SignTypes, features_of, made_of

Float32 = npt.NDArray[np.float32]

EACH: Final = {"fit": (280, 16_000, 5_000), "check": (20, 4_000, 0)}
"""Renders of each listed face, of plates of no listed type, and of those of the families MORE, for the fit and for
threshold and figures."""
ALTERED: Final = list(UNLISTED).index("altered")
_SEED: Final = {"fit": 1, "check": 2}
_HIDDEN: Final = 256
_EPOCHS, _BATCH, _RATE = 28, 256, 2.0e-3
_DROP_IN, _DROP_HIDDEN, _DECAY, _SMOOTH = 0.1, 0.3, 1.0e-3, 0.03
MOST_FALSE: Final = 0.02
"""Share of plates of no listed type that may get one: the threshold follows."""


@dataclass(frozen=True, eq=False)
class Plates:
    """Features of rendered plates."""

    features: npt.NDArray[np.uint8]
    label: npt.NDArray[np.int16]
    """Number of the face in the list; its length for plates of no listed type."""
    size_px: Float32
    family: npt.NDArray[np.int8]
    """Of plates of no listed type: number in UNLISTED, HELD_OUT and MORE, one after the other; -1 for listed ones."""


def rendered(part: str, folder: Path) -> Plates:
    """Renders of a part ("fit", "check"), from the folder where they are there."""
    file = folder / f"sign_plates_{part}.npz"
    if not file.is_file():
        each, others, more = EACH[part]
        families = [*UNLISTED.values(), *HELD_OUT.values(), *MORE.values()]
        common = len(families) - len(MORE) - (0 if part == "check" else len(HELD_OUT))
        rows = [(k, -1) for k in range(len(FACES)) for _ in range(each)]
        rows += [(len(FACES), n % common) for n in range(others)]
        rows += [(len(FACES), len(families) - 1 - n % len(MORE)) for n in range(more)]
        out = Plates(np.empty((len(rows), COUNT), np.uint8), np.array([r[0] for r in rows], np.int16),
                     np.empty(len(rows), np.float32), np.array([r[1] for r in rows], np.int8))  # fmt: skip
        for n, (label, family) in enumerate(rows):
            rng = np.random.default_rng([_SEED[part], n])
            out.size_px[n] = size = size_by_chance(rng)
            cut = seen(families[family](rng) if family >= 0 else face_drawing(FACES[label], rng), size, rng)
            while family == ALTERED and cut.is_grey:  # colours alone may tell that it is not listed
                cut = seen(families[family](rng), size, rng)
            out.features[n] = features_of(cut)
            if n % 2000 == 0:
                print(part, n, len(rows), round(time.process_time()), file=sys.stderr, flush=True)
        np.savez(file, **vars(out))
    with np.load(file) as held:
        return Plates(**{name: held[name] for name in held.files})


class Net:
    """A net of one hidden layer during its fit, by Adam (Kingma & Ba 2015) with dropout; 32 bits."""

    def __init__(self, plates: Plates, hidden: int) -> None:
        self._rng = np.random.default_rng(3)
        self.mean = plates.features.mean(axis=0).astype(np.float32)
        self.scale = (1.0 / (plates.features.std(axis=0) + 4.0)).astype(np.float32)
        outputs = len(FACES) + 1
        sizes = ((COUNT, hidden), (hidden,), (hidden, outputs), (outputs,))
        self.parts = [
            (
                self._rng.standard_normal(n, np.float32) * np.float32(np.sqrt(2 / n[0]))
                if len(n) > 1
                else np.zeros(n, np.float32)
            )
            for n in sizes
        ]
        self._first, self._second = ([np.zeros_like(p) for p in self.parts] for _ in range(2))
        self._steps = 0

    def fit(self, plates: Plates) -> None:
        """Fit to plates."""
        rows = len(plates.label)
        for epoch in range(_EPOCHS):
            order, lost = self._rng.permutation(rows), 0.0
            for first in range(0, rows - _BATCH + 1, _BATCH):
                own = order[first : first + _BATCH]
                rate = _RATE * 0.5 * (1 + np.cos(np.pi * (epoch + first / rows) / _EPOCHS))
                lost += self._step(plates.features[own], plates.label[own], rate)
            print(
                "epoch",
                epoch,
                round(lost / (rows // _BATCH), 4),
                round(time.process_time()),
                file=sys.stderr,
                flush=True,
            )

    def _step(self, features: npt.NDArray[np.uint8], label: npt.NDArray[np.int16], rate: float) -> float:
        w1, b1, w2, b2 = self.parts
        x = (features.astype(np.float32) - self.mean) * self.scale
        x *= (self._rng.random(x.shape, np.float32) >= _DROP_IN) / np.float32(1 - _DROP_IN)
        z = x @ w1 + b1
        kept = (z > 0) * ((self._rng.random(z.shape, np.float32) >= _DROP_HIDDEN) / np.float32(1 - _DROP_HIDDEN))
        h = z * kept
        odds = h @ w2 + b2
        odds -= odds.max(axis=1, keepdims=True)
        share = np.exp(odds)
        share /= share.sum(axis=1, keepdims=True)
        wanted = np.full(share.shape, _SMOOTH / share.shape[1], np.float32)
        rows = np.arange(len(label))
        wanted[rows, label] += 1 - _SMOOTH
        lost = float(-np.log(share[rows, label] + 1e-9).mean())
        d2 = (share - wanted) / np.float32(len(label))
        d1 = (d2 @ w2.T) * kept
        slopes = (x.T @ d1, d1.sum(axis=0), h.T @ d2, d2.sum(axis=0))
        self._steps += 1
        even = rate * np.sqrt(1 - 0.999**self._steps) / (1 - 0.9**self._steps)
        for part, slope, first, second in zip(self.parts, slopes, self._first, self._second, strict=True):
            first[:] += np.float32(0.1) * (slope - first)
            second[:] += np.float32(0.001) * (slope * slope - second)
            part[:] -= np.float32(even) * first / (np.sqrt(second) + np.float32(1e-8))
            if part.ndim == 2:
                part[:] *= np.float32(1 - rate * _DECAY)
        return lost

    def stated(self, plates: Plates) -> dict[str, Any]:
        """The layers in whole weights, as the file has them. `plates` tell how far hidden units reach."""
        w1, b1, w2, b2 = (p.astype(np.float64) for p in self.parts)
        w1, b1 = w1 * self.scale[:, None], b1 - (self.mean * self.scale) @ w1
        reach = np.quantile(np.maximum(plates.features[::17].astype(np.float64) @ w1 + b1, 0), 0.9999, axis=0) + 1e-6
        unit = MOST_HIDDEN / 2 / reach  # the largest values seldom exceed twice that
        return {"hidden": _whole(w1 * unit, b1 * unit), "out": _whole(w2 / unit[:, None], b2)}


def _whole(weights: npt.NDArray[np.float64], offset: npt.NDArray[np.float64]) -> dict[str, Any]:
    factor = np.abs(weights).max(axis=0) / 127.0
    whole = np.rint(weights / factor).astype(np.int8)
    return {
        "factor": [float(f"{v:.7g}") for v in factor], "offset": [float(f"{v:.7g}") for v in offset],
        "weights": base64.b64encode(whole.tobytes()).decode(),
    }  # fmt: skip


def content(stated: dict[str, Any], record: dict[str, Any], threshold: float) -> dict[str, Any]:
    """What the file states."""
    types = [{"codes": face.code.split(), "name": face.name, "shape": face.shape, "colours": list(face.colours)}
             for face in FACES]  # fmt: skip
    return {"types": types, "threshold": threshold, "record": record, **stated}


def model(stated: dict[str, Any], threshold: float) -> SignTypes:
    """The recogniser that a file with these layers is."""
    return made_of(content(stated, {}, threshold))


def tempered(stated: dict[str, Any], by: float) -> dict[str, Any]:
    """The layers with the logarithms of the weights divided by a temperature."""
    out = stated["out"]
    return {**stated, "out": {**out, **{k: [float(f"{v / by:.7g}") for v in out[k]] for k in ("factor", "offset")}}}


def shares(odds: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Probabilities (n, types + 1)."""
    out = np.exp(odds - odds.max(axis=1, keepdims=True))
    return np.asarray(out / out.sum(axis=1, keepdims=True))


def temperature(odds: npt.NDArray[np.float64], label: npt.NDArray[np.int16]) -> float:
    """The temperature (Guo et al. 2017) that makes the labels most probable."""
    steps = np.geomspace(0.5, 3.0, 60)
    rows = np.arange(len(label))
    return float(steps[np.argmin([-np.log(shares(odds / t)[rows, label] + 1e-12).mean() for t in steps])])


def threshold_of(share: npt.NDArray[np.float64], plates: Plates) -> float:
    """The least probability with which unlisted plates, and those of families that the fit never saw, get few names."""
    best = share[:, :-1].max(axis=1)
    other = plates.label == len(FACES)
    held_out = other & (plates.family >= len(UNLISTED))
    limits = [np.quantile(best[held_out], 1 - MOST_FALSE), np.quantile(best[other], 1 - MOST_FALSE)]
    return float(np.ceil(max(limits) * 1000) / 1000)


def figures(share: npt.NDArray[np.float64], plates: Plates, threshold: float) -> dict[str, Any]:
    """Shares of right, wrong and unknown of listed plates, and of named among unlisted ones, by size in pixels."""
    told = np.where(share[:, :-1].max(axis=1) >= threshold, share[:, :-1].argmax(axis=1), len(FACES))
    listed, out = plates.label < len(FACES), {}
    for low, high in [*itertools.pairwise(SIZES_PX), (SIZES_PX[0], SIZES_PX[-1])]:
        rows = (plates.size_px >= low) & (plates.size_px < high)
        own, other = rows & listed, rows & ~listed
        out[f"{low:.0f}-{high:.0f} px"] = {
            "listed": int(own.sum()), "right": _share(told[own] == plates.label[own]),
            "wrong": _share((told[own] != plates.label[own]) & (told[own] < len(FACES))),
            "unknown": _share(told[own] == len(FACES)), "unlisted": int(other.sum()),
            "named": _share(told[other] < len(FACES)),
        }  # fmt: skip
    return out


def of_three(known: SignTypes, count: int) -> dict[str, Any]:
    """Shares of right and wrong types by the nearest of three pictures of a plate, and by the vote of all."""
    told: list[list[bool]] = []
    for n in range(count):
        rng = np.random.default_rng([4, n])
        face = FACES[n % len(FACES)]
        drawing, near_px = face_drawing(face, rng), size_by_chance(rng)
        cuts = [seen(drawing, near_px * part, rng, np.random.default_rng([5, n])) for part in (1.0, 0.75, 0.55)]
        both = [known.type_of(own, "both")[0] for own in (cuts[:1], cuts)]
        told.append([v for one in both for v in (one == face.code, one not in (face.code, UNKNOWN))])
    right, wrong, right_of_all, wrong_of_all = (round(float(v), 4) for v in np.mean(told, axis=0))
    return {"plates": count, "nearest": {"right": right, "wrong": wrong},
            "vote of three": {"right": right_of_all, "wrong": wrong_of_all}}  # fmt: skip


def _share(rows: npt.NDArray[np.bool_]) -> float:
    return round(float(rows.mean()), 4) if rows.size else float("nan")


def halves(plates: Plates) -> tuple[Plates, Plates]:
    """Plates for temperature and threshold, and plates for figures."""
    odd = np.arange(len(plates.label)) % 2 == 1
    return tuple(Plates(*(v[rows] for v in vars(plates).values())) for rows in (~odd, odd))  # type: ignore[return-value]


def main() -> None:
    """Render, fit, write, print the figures."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fit_sign_types", description="Fit the recogniser of signs."
    )
    parser.add_argument("--folder", type=Path, required=True, help="where renders are kept")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    check, plates = rendered("check", folder), rendered("fit", folder)
    net = Net(plates, _HIDDEN)
    net.fit(plates)
    settled, judged = halves(check)
    stated = net.stated(plates)
    stated = tempered(stated, temperature(model(stated, 0.5).odds(settled.features), settled.label))
    known = model(stated, 0.5)
    threshold = threshold_of(shares(known.odds(settled.features)), settled)
    share = shares(known.odds(judged.features))
    record = {
        "numpy": np.__version__, "renders": EACH, "seeds": _SEED, "hidden": _HIDDEN, "epochs": _EPOCHS, "batch": _BATCH,
        "rate": _RATE, "dropout": [_DROP_IN, _DROP_HIDDEN], "decay": _DECAY, "smoothing": _SMOOTH,
        "most false": MOST_FALSE, "held out": figures(share, judged, threshold),
        "three pictures": of_three(model(stated, threshold), 8 * len(FACES)),
    }  # fmt: skip
    text = json.dumps(content(stated, record, threshold), ensure_ascii=False, separators=(",", ":"))
    text = text.replace("},{", "},\n{").replace('],"', '],\n"') + "\n"
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(text, encoding="utf-8")
    print(json.dumps(record, indent=1))
    print(f'DIGEST: Final = "{hashlib.sha256(text.encode()).hexdigest()[:16]}"')


if __name__ == "__main__":
    main()
