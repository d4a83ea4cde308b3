"""``surface_mesh``: the reconstructed surface of a tile as a triangle mesh."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, cast

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from roadscan.compute.array_types import Float64
from roadscan.core.strict import Strict
from roadscan.pictures.views import PictureRule
from roadscan.store.codecs import SOFTWARE
from roadscan.store.codecs.mesh import Mesh, check_glb, check_ply, write_glb, write_ply
from roadscan.surface.tile import SurfaceTile
from roadscan.tiles.product import ProductContext, SurfaceProduct


def mesh_of(easting_m: Float64, northing_m: Float64, height_m: Float64, colour: npt.NDArray[np.uint8]) -> Mesh:
    """Return two triangles between four nodes with a height, one between three.

    Of a square's diagonals the one whose ends differ less in height is taken: edges and cracks keep their lines.

    Parameters
    ----------
    easting_m, northing_m : (columns,), (rows,) from the mesh's origin.
    height_m : (rows, columns), row 0 the southernmost; NaN where there is no node.
    colour : (rows, columns) or (rows, columns, 3).
    """
    known = ~np.isnan(height_m)
    sw, se, nw, ne = (known[r, c] for r, c in _CORNERS)
    south_west, south_east, north_west, north_east = (height_m[r, c] for r, c in _CORNERS)
    with np.errstate(invalid="ignore"):
        rising = np.abs(south_west - north_east) <= np.abs(south_east - north_west)
    number = np.arange(known.size, dtype=np.int64).reshape(known.shape)
    a, b, d, c = (number[r, k] for r, k in _CORNERS)
    whole = sw & se & nw & ne
    parts = [
        _picked(whole & rising, a, b, c), _picked(whole & rising, a, c, d),
        _picked(whole & ~rising, a, b, d), _picked(whole & ~rising, b, c, d),
        _picked(sw & se & ne & ~nw, a, b, c), _picked(sw & ne & nw & ~se, a, c, d),
        _picked(sw & se & nw & ~ne, a, b, d), _picked(se & ne & nw & ~sw, b, c, d),
    ]  # fmt: skip
    corners = np.concatenate(parts)
    used, triangles = np.unique(corners, return_inverse=True)
    row, column = np.divmod(used, known.shape[1])
    places = np.stack([easting_m[column], northing_m[row], height_m.ravel()[used]], axis=-1)
    return Mesh(places.astype(np.float32), colour[row, column], triangles.reshape(-1, 3).astype(np.uint32))


_LOW, _HIGH = slice(None, -1), slice(1, None)  # First and second node of an edge, along an axis.
_CORNERS: Final = ((_LOW, _LOW), (_LOW, _HIGH), (_HIGH, _LOW), (_HIGH, _HIGH))


def _picked(where: npt.NDArray[np.bool_], *corners: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.stack([corner[where] for corner in corners], axis=-1)


_UNKNOWN_GREY = 128  # Grey of vertices without an intensity.


class SurfaceMeshOptions(Strict):
    """Settings of `surface_mesh`."""

    format: Literal["glb", "ply"] = "glb"
    """Binary glTF 2.0, for viewers and the web, or binary PLY, for point-cloud programs."""
    spacing_m: float = Field(default=0.02, gt=0.0, le=1.0)
    """Spacing of the vertices (m), rounded down to whole cells of the surface, at least one: 5 mm give 30 MB and more
    a tile."""
    black: float = 0.0
    """Intensity (digital number) that is drawn black. The same for all tiles, so that their meshes match."""
    white: float = 65_535.0
    """Intensity (digital number) that is drawn white; 65,535 is the brightest that a sensor says, of 8 bits or 16."""

    colours: Literal["intensity", "camera"] = "intensity"
    """"intensity": grey. "camera": as the survey's pictures show the vertices, and grey where none does."""
    cameras: tuple[str, ...] = ()
    """Cameras of the rig whose pictures count; where empty all that have an interior orientation."""
    camera_reach_m: float = Field(default=15.0, gt=0.0, le=100.0)
    """Farthest distance from a camera to a vertex that it colours (m)."""
    camera_angle_deg: float = Field(default=10.0, gt=0.0, lt=90.0)
    """Least angle between a vertex's ray and the horizon: flatter ones see the road as streaks (degrees)."""
    camera_border_px: int = Field(default=8, ge=1, le=1000)
    """Pixels along the border of the pictures that colour nothing."""

    @model_validator(mode="after")
    def _in_order(self) -> SurfaceMeshOptions:
        if self.black >= self.white:
            raise ValueError(f"black {self.black:g} is not below white {self.white:g}")
        return self


class SurfaceMesh(SurfaceProduct):
    """A mesh a tile: smoothed heights at the centres of cells, intensity or the survey's pictures as colour.

    Coordinates are metres on the map from an origin near the tile, which the file states (`origin_m`: easting,
    northing, height; in glTF in `asset.extras`, in PLY as a comment), because 32-bit floats hold no map coordinates.
    PLY: x east, y north, z up; glTF: x east, y up, z south. Vertices lie on a lattice of the whole map, and a tile's
    mesh ends on the first of the next tile's: meshes of neighbours touch, and agree in their colours.

    With `colours = "camera"` a vertex has the colour of the picture that shows it finest: of those within
    `camera_reach_m`, at `camera_angle_deg` or steeper, `camera_border_px` inside the picture and off the survey vehicle
    (`own_vehicle_px` of the rig file), the one with least distance over focal length; of equals the earliest. PLY has
    the picture's values (sRGB), glTF the linear ones that it asks for.
    """

    name: ClassVar[str] = "surface_mesh"
    title: ClassVar[str] = "reconstructed surface of a tile as a triangle mesh (glTF or PLY), in grey or in colours"
    suffix: ClassVar[str] = ".glb"
    default: ClassVar[bool] = False
    options: ClassVar[type[Strict]] = SurfaceMeshOptions

    def suffix_for(self, options: Strict) -> str:
        """Returns ``.glb`` or ``.ply``."""
        return f".{cast(SurfaceMeshOptions, options).format}"

    def picture_rule(self, options: Strict) -> PictureRule | None:
        """Returns the rule of the settings if they ask for colours of cameras."""
        settings = cast(SurfaceMeshOptions, options)
        if settings.colours != "camera":
            return None
        return PictureRule(
            settings.cameras, settings.camera_reach_m, settings.camera_angle_deg, settings.camera_border_px
        )

    def coloured_nodes(self, surface: SurfaceTile, options: Strict) -> tuple[range, range]:
        """Returns the mesh's lattice."""
        return _lattice(surface, cast(SurfaceMeshOptions, options))

    def write(self, surface: SurfaceTile, options: Strict, context: ProductContext, path: Path) -> None:
        """Write the mesh."""
        settings = cast(SurfaceMeshOptions, options)
        corner = context.grid.bounds(surface.tile)
        lowest = float(np.nanmin(surface.height_m[surface.inner]))
        origin_m = (corner.easting_min_m, corner.northing_min_m, float(math.floor(lowest)))
        mesh = surface_mesh(surface, settings, origin_m)
        about: dict[str, Any] = {
            "survey": context.survey_id,
            "tile": str(surface.tile),
            "crs": context.map.crs or context.map.local_name,
            "origin_m": origin_m,
        }
        if settings.format == "glb":
            write_glb(path, mesh, {**about, "axes": "x east, y up, z south"}, SOFTWARE)
        else:
            write_ply(path, mesh, {**about, "axes": "x east, y north, z up"})

    def check(self, path: Path) -> None:
        """Compare the arrays with their stored digest."""
        (check_ply if path.suffix == ".ply" else check_glb)(path)


def surface_mesh(surface: SurfaceTile, options: SurfaceMeshOptions, origin_m: tuple[float, float, float]) -> Mesh:
    """Returns the mesh of a tile and of the next vertices, in metres from `origin_m` (easting, northing, height)."""
    row, column = _lattice(surface, options)
    easting_m, northing_m = surface.window.nodes_m()
    picked = np.ix_(row, column)
    light = surface.intensity[picked]
    grey = np.clip((light - options.black) * (255.0 / (options.white - options.black)), 0.0, 255.0)
    colour = np.rint(np.where(np.isnan(grey), _UNKNOWN_GREY, grey)).astype(np.uint8)
    if surface.colours is not None:
        colour = np.where(surface.colours.seen[:, :, None], surface.colours.colour, colour[:, :, None])
    return mesh_of(
        easting_m[column] - origin_m[0], northing_m[row] - origin_m[1], surface.height_m[picked] - origin_m[2],
        colour,
    )  # fmt: skip


def _lattice(surface: SurfaceTile, options: SurfaceMeshOptions) -> tuple[range, range]:
    """Returns rows and columns of the vertices in the arrays."""
    window, rows_columns = surface.window, surface.height_m.shape
    steps = [max(1, math.floor(options.spacing_m / edge + 1e-9)) for edge in surface.cell_m]
    return (
        _multiples(window.first_row, rows_columns[0], surface.halo, steps[1]),
        _multiples(window.first_column, rows_columns[1], surface.halo, steps[0]),
    )


def _multiples(first: int, count: int, halo: int, step: int) -> range:
    """Returns the indices of the multiples of `step` in the tile, and of the first one beyond it."""
    own, end = first + halo, first + count - halo
    return range(-(-own // step) * step - first, -(-end // step) * step - first + 1, step)
