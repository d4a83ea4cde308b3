"""The truth beside a simulated survey: the scene from which it was made, and every height on the road."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy.typing as npt
import pyarrow.parquet as pq
from pydantic import ValidationError

from roadscan.compute.array_types import Float64
from roadscan.core.errors import FormatError
from roadscan.simulate.scene import Scene
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import objects_table

TRUTH_FOLDER: Final = "truth"
SCENE_FILE: Final = "scene.json"
OBJECTS_FILE: Final = "objects.parquet"


@dataclass(frozen=True)
class Truth:
    """The truth of a simulated survey."""

    scene: Scene
    surface: Surface
    folder: Path
    """Folder with ``scene.json``, the true trajectories and, if they were asked for, the true hits."""

    def height_m(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> Float64:
        """Return the true ellipsoidal height at map points (any shape, m), with texture; NaN off road and verge."""
        return self.surface.height_m(easting_m, northing_m)

    def intensity(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> Float64:
        """Return the true intensity at map points (any shape), digital numbers of a profiler."""
        return self.surface.intensity(easting_m, northing_m)

    def station_offset_m(self, easting_m: npt.ArrayLike, northing_m: npt.ArrayLike) -> tuple[Float64, Float64]:
        """Return station and offset from the reference line (right positive) of map points (any shape, m)."""
        return self.surface.station_offset_m(easting_m, northing_m)

    def trajectory_file(self, run: str) -> Path:
        """Return the Parquet file of a run's true poses (columns of the table ``trajectory``, world frame ECEF)."""
        return self.folder / "trajectory" / f"{run}.parquet"

    def camera_file(self, run: str, camera: str = "camera") -> Path:
        """Return the Parquet file of a run's pictures: epoch, file, and the camera's true pose (world frame ECEF)."""
        return self.folder / camera / f"{run}.parquet"

    @property
    def cameras_file(self) -> Path:
        """JSON of the cameras as they are: lens, mounting, clock, shutter."""
        return self.folder / "cameras.json"

    @property
    def control_file(self) -> Path:
        """CSV of the true places of the control points, where there are cameras or upright targets: what they are,
        easting, northing, height.
        """
        return self.folder / "control.csv"

    @property
    def rig_file(self) -> Path:
        """Rig file with the true mountings, and the encoder's true scale."""
        return self.folder / "RIG.toml"

    @property
    def clocks_file(self) -> Path:
        """CSV of the sensors' true clocks: how far each is ahead at an epoch, and its drift."""
        return self.folder / "clocks.csv"

    @property
    def objects_file(self) -> Path:
        """Parquet file of all objects beside the road, see :func:`roadscan.simulate.things.objects_table`."""
        return self.folder / OBJECTS_FILE

    def hits_file(self, run: str, sensor: str) -> Path:
        """Return the Parquet file of the points that a sensor's beams hit in a run."""
        return self.folder / "hits" / run / f"{sensor}.parquet"


def load(folder: str | Path) -> Truth:
    """Return the truth of the simulated survey in `folder` (or of its folder ``truth``).

    Raises
    ------
    FormatError
        where the folder holds no truth, or one written by another version.
    """
    given = Path(folder)
    truth = given if (given / SCENE_FILE).is_file() else given / TRUTH_FOLDER
    file = truth / SCENE_FILE
    if not file.is_file():
        raise FormatError(
            "there is no truth here",
            expected=f"the folder of a simulated survey, with {TRUTH_FOLDER}/{SCENE_FILE} in it",
            file=given,
        )
    try:
        scene = Scene.model_validate_json(file.read_bytes())
    except ValidationError as error:
        raise FormatError(
            f"the scene cannot be read: {error.errors()[0]['msg']}",
            expected="a scene written by this version of roadscan",
            change="simulate the survey again",
            file=file,
        ) from error
    return Truth(scene, Surface(scene), truth)


def save(scene: Scene, folder: Path) -> None:
    """Write the scene into the truth folder of the survey in `folder`."""
    target = folder / TRUTH_FOLDER / SCENE_FILE
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(scene.model_dump_json(indent=1) + "\n", encoding="utf-8")


def save_objects(scene: Scene, surface: Surface, folder: Path) -> None:
    """Write the table of objects into the truth folder of the survey in `folder`."""
    pq.write_table(objects_table(scene, surface), folder / TRUTH_FOLDER / OBJECTS_FILE)
