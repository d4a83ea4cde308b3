"""Types of signs in the table that the stages write, on a simulated street whose plates show known faces."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import geopandas
import numpy as np
import pandas as pd
import pytest

import roadscan
from benchmarks.sign_faces import FACES, style_of
from roadscan.run.engine.compute import Inline
from roadscan.run.session import Session
from roadscan.run.stage import stage_named
from roadscan.simulate import Scene, simulate
from roadscan.store.store import Store
from roadscan.survey.run import run_stages
from tests.assets.known_assets import KnownSigns, true_signs
from tests.assets.posts import only_kinds
from tests.surveys import Lines, changed

SHOWN = ("vienna:B2a", "vienna:C14-50", "vienna:C1", "vienna:A13", "vienna:D2-right", "vienna:E12a", "vienna:B3",
         "mutcd:R2-1-35", "mutcd:W1-2-left", "mutcd:R5-1", "mutcd:W2-6", "vienna:A19")  # fmt: skip
"""Faces on the right and on the left of the road, from 9 m on each 1.5 m."""
PLAIN = ({"shape": "triangle", "width_m": 0.9, "rim": "red"}, {"shape": "round", "colour": "blue"},
         {"shape": "rectangle", "width_m": 0.9, "colour": "green", "text": "ZURICH"})  # fmt: skip
"""Plates of no listed type beside them."""


def signs(folder: Path) -> list[dict[str, Any]]:
    """Signs of the scene: faces that no fit has seen, and plain ones."""
    out: list[dict[str, Any]] = []
    for number, code in enumerate(SHOWN):
        face = next(one for one in FACES if code in one.code.split())
        picture, _ = face.drawn(style_of(np.random.default_rng([78, number])))
        cv2.imwrite(str(folder / f"{number}.png"), picture[:, :, ::-1])
        shape = "rectangle" if face.shape == "square" else face.shape
        out.append({"shape": shape, "width_m": 0.8 * min(face.aspect, 1.1), "height_m": 0.8,
                    "face": str(folder / f"{number}.png")})  # fmt: skip
    out += [dict(one) for one in PLAIN]
    for number, one in enumerate(out):
        one |= {"station_m": 9.0 + 1.5 * (number // 2), "offset_m": (4.6, -4.2)[number % 2],
                "clearance_m": 0.7 + 1.0 * (number // 2 % 3)}  # fmt: skip
    return out


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Iterator[pd.DataFrame]:
    folder = tmp_path_factory.mktemp("street")
    scene = Scene.load("demo").changed(
        length_m=22.0, passes=[{"lane": 2, "direction": "forward"}], profilers={"on": False},
        lidar={"range_max_m": 9.0}, vehicle={"speed_m_per_s": 16.0}, roadside={"signs": signs(folder)},
        camera={"on": True, "colour": True, "every_m": 3.0, "width_px": 640, "height_px": 400, "focal_px": 560.0,
                "noise": 1.0, "mount": {"lever_arm_body_m": [0.9, -0.25, -1.15], "pitch_deg": -2.0}},
    )  # fmt: skip
    file = simulate(scene.noiseless(), folder / "survey").survey_file
    KnownSigns.assets = true_signs(folder / "survey")
    with only_kinds(KnownSigns):
        survey = changed(roadscan.open_survey(file).survey,
                         {"assets": {"tile_m": 10.0}, "tiles__size_m": 10.0, "adjust__on": False})  # fmt: skip
        own = Session(survey, Store(str(folder / "store"), survey.config.id), Inline(), None, Lines())
        run_stages(own, [stage_named(name) for name in ("ingest", "navigate", "footprints", "assets")])
        found = geopandas.read_parquet(own.store.path("products/assets/road_signs.parquet"))
        places = np.array([shape.coords[0][:2] for shape, _ in KnownSigns.assets])
        away = np.hypot(*(found[["easting_m", "northing_m"]].to_numpy()[:, None] - places).transpose(2, 0, 1))
        yield found.iloc[away.argmin(axis=0)].reset_index(drop=True)


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_types_of_a_street_are_told_and_plain_plates_are_unknown(table: pd.DataFrame) -> None:
    told, pictures = table["type"], table["pictures"].notna()
    assert (told.notna() == pictures).all() and told.notna().sum() >= 12
    codes = [next(one.code for one in FACES if code in one.code.split()) for code in SHOWN]
    own = told[: len(SHOWN)]
    right, unknown = (own == codes).sum(), (own == "unknown").sum()
    assert right >= 8 and right + unknown + own.isna().sum() == len(SHOWN)
    assert set(told[len(SHOWN) :].dropna()) == {"unknown"}
    assert (table["type_probability"].notna() == (told.notna() & (told != "unknown"))).all()
