"""Pictures of cameras with their poses, and cut-outs of assets."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import DamagedError
from roadscan.georeference.picture_axes import camera_from_map
from roadscan.measuring.poses import picture_poses
from roadscan.navigation.tasks.taken_pictures import taken_pictures
from roadscan.pictures.placed import Pictures as PlacedPictures
from roadscan.pictures.views import HEIGHT, WIDTH
from roadscan.privacy.hider import Hider, decoded, encoded
from roadscan.privacy.hiding import KINDS
from roadscan.run.code_reach import code_digest
from roadscan.run.engine.fingerprint import key_of
from roadscan.site.document import Ask, Document, json_bytes, json_document
from roadscan.site.material import Material, sheet_name
from roadscan.site.part import SitePart
from roadscan.site.parts.vectors import site_layers
from roadscan.site.site_pictures import (
    SHOWN_AS_THEY_ARE,
    cut_out_records,
    cut_out_url,
    hider_for,
    picture_url,
    placed_pictures,
)
from roadscan.store.codecs.jpeg_segments import comment_of, with_comment
from roadscan.store.manifest import OutputRecord, read_recorded

_LENS: Final = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_CODE: Final = "roadscan.site.parts.pictures"
PRIVACY: Final = "pictures/privacy.json"
"""What was hidden in each picture."""


class Pictures(SitePart):
    """Pictures with a pose, by kilometre sheet of the camera."""

    name = "pictures"
    position = 600

    def members(self, material: Material) -> Mapping[str, Any]:
        """Return the path of the index, and what is done with people and vehicles in the pictures."""
        held = placed_pictures(material)
        told: dict[str, Any] = {"pictures": material.privacy}
        if material.privacy == "blur" and held is not None:
            told["counts"] = PRIVACY
        return {
            "pictures": {"url": "pictures/index.json", "pictures": len(held)} if held is not None else None,
            "privacy": told,
        }

    def documents(self, material: Material) -> Iterator[Document]:
        """Yield the index, poses by sheet, and the pictures."""
        held = placed_pictures(material)
        if held is None:
            return
        sheets: dict[str, list[int]] = {}
        for number, (east, north) in enumerate(held.place_m.tolist()):
            sheets.setdefault(sheet_name(east, north), []).append(number)
        parts = [
            {"url": f"pictures/{name}.json", "bounds_m": _bounds(held, numbers), "pictures": len(numbers)}
            for name, numbers in sorted(sheets.items())
        ]
        epochs = _epochs(material, held)
        yield json_document("pictures/index.json", {"cameras": _cameras(held), "parts": parts})
        for name, numbers in sorted(sheets.items()):
            yield json_document(f"pictures/{name}.json", _poses(material, held, numbers, epochs))
        hider = hider_for(material)
        if hider is None:
            for number in range(len(held)):
                yield Document(picture_url(material, held, number), _key(held, number), _copied(held, number))
        else:
            yield from _hidden_pictures(material, held, hider)
        shown = {one.get("url") for layer in site_layers(material)[0] for row in layer.evidence for one in row}
        for record in cut_out_records(material).values():
            if cut_out_url(record) in shown:
                own = (record.digest,) if hider is None else (record.digest, hider.key)
                yield Document(cut_out_url(record), key_of(*own), _stored(material, record, hider))


def _stored(material: Material, record: OutputRecord, hider: Hider | None) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        content = read_recorded(material.store, record)
        path.write_bytes(content if hider is None else encoded(hider.hide_found(decoded(content))))

    return write


def _hidden_pictures(material: Material, held: PlacedPictures, hider: Hider) -> Iterator[Document]:
    """Yield pictures with people and vehicles hidden, and what was hidden in each."""
    keys = [key_of(_key(held, number), hider.key_of(held, number)) for number in range(len(held))]
    urls = [picture_url(material, held, number) for number in range(len(held))]
    for number, (url, key) in enumerate(zip(urls, keys, strict=True)):
        yield Document(url, key, _hidden(held, number, hider))

    def write(path: Path, ask: Ask) -> None:
        rows: dict[str, list[Any]] = {"url": [], **{what: [] for what in KINDS}}
        for url in urls:
            file = ask(url)
            if file.is_file():  # a damaged picture is left out, and named as a failure
                counts = json.loads(comment_of(file.read_bytes()))
                rows["url"].append(url)
                for what in KINDS:
                    rows[what].append(int(counts[what]))
        told = {
            "pictures": len(rows["url"]), "sources": hider.sources, "hidden": rows,
            "total": {what: sum(rows[what]) for what in KINDS},
        }  # fmt: skip
        path.write_bytes(json_bytes(told))

    yield Document(PRIVACY, key_of(code_digest(_CODE), keys, hider.sources), write)


def _hidden(held: PlacedPictures, number: int, hider: Hider) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        source = held.path(number)
        try:
            picture, counts = hider.hide(held, number, decoded(source.read_bytes()))
        except OSError as error:
            raise DamagedError(f"the picture {held.name(number)} cannot be read: {error}", file=source) from error
        path.write_bytes(with_comment(encoded(picture), json.dumps(counts, sort_keys=True)))

    return write


def _bounds(held: PlacedPictures, numbers: list[int]) -> list[float]:
    own = held.place_m[numbers]
    return [round(float(v), 3) for v in (*own.min(axis=0), *own.max(axis=0))]


def _cameras(held: PlacedPictures) -> list[dict[str, Any]]:
    found = []
    for number, log in enumerate(held.logs):
        own = np.flatnonzero(held.log == number)
        if not own.size:
            continue
        lens = held.views.lens_of(own[0])
        values = dict(zip(_LENS, lens.parameters.tolist(), strict=False))
        found.append(
            {
                "camera": number, "run": log.run, "title": log.sensor,
                "model": "equirectangular" if lens.is_around else "perspective",
                "width_px": round(float(lens.parameters[WIDTH])), "height_px": round(float(lens.parameters[HEIGHT])),
                "focal_px": [values["fx"], values["fy"]], "principal_px": [values["cx"], values["cy"]],
                "distortion": [values[n] for n in _LENS[4:]],
            }
        )  # fmt: skip
    return found


def _poses(material: Material, held: PlacedPictures, numbers: list[int], epochs: list[str]) -> dict[str, Any]:
    views = held.views.picked(np.array(numbers, np.int64))
    place, turn = np.empty((len(numbers), 3)), np.empty((len(numbers), 3, 3))
    for world, name in enumerate(held.worlds):
        own = views.world == world
        if own.any():
            place[own], turn[own] = camera_from_map(
                held.map, name, views.eye_world_m[own], views.opencv_from_world[own]
            )
    return {
        "pictures": len(numbers), "id": numbers, "camera": [int(held.log[k]) for k in numbers],
        "url": [picture_url(material, held, k) for k in numbers], "name": [held.name(k) for k in numbers],
        "epoch_gps_ns": [epochs[k] for k in numbers],
        "easting_m": np.round(place[:, 0], 5), "northing_m": np.round(place[:, 1], 5),
        "height_m": np.round(place[:, 2], 5), "camera_from_map": turn.reshape(-1, 9),
        "sigma_m": np.round(_sigma_m(material)[numbers], 4),
    }  # fmt: skip


@functools.lru_cache(maxsize=2)
def _sigma_m(material: Material) -> npt.NDArray[np.float64]:
    """Return the horizontal 1 σ (n,) of the projection centres, √(σ_north² + σ_east²)."""
    held = placed_pictures(material)
    if held is None:
        return np.zeros(0)
    spread = picture_poses(material.plan, held).covariance
    out: npt.NDArray[np.float64] = np.sqrt(spread[:, 0, 0] + spread[:, 1, 1])
    return out


def _epochs(material: Material, held: PlacedPictures) -> list[str]:
    """Return GPS time of each picture (ns) by its camera's estimated clock."""
    known: dict[tuple[str, str], int] = {}
    for log in held.logs:
        for taken in taken_pictures(material.store, material.plan.records, log.sensor):
            known |= {(taken.record.key, f): e for f, e in zip(taken.files, taken.epochs_gps_ns.tolist(), strict=True)}
    return [str(known[held.logs[log].key, file]) for log, file in zip(held.log.tolist(), held.files, strict=True)]


def _key(held: PlacedPictures, number: int) -> str:
    return key_of(code_digest(_CODE), held.logs[int(held.log[number])].key, held.files[number])


def _copied(held: PlacedPictures, number: int) -> Any:
    def write(path: Path, _ask: Ask) -> None:
        source = held.path(number)
        try:
            if source.suffix.lower() in SHOWN_AS_THEY_ARE:
                path.write_bytes(source.read_bytes())
                return
            from PIL import Image

            with Image.open(source) as image:
                image.convert("RGB").save(path, format="JPEG", quality=90)
        except (OSError, SyntaxError, ValueError) as error:
            raise DamagedError(f"the picture {held.name(number)} cannot be read: {error}", file=source) from error

    return write
