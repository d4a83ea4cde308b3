"""Writes the pictures of docs/simulator.md: what the shipped scenes look like, and what their sensors record.

    python docs/simulator_pictures.py            all scenes, into docs/pictures
    python docs/simulator_pictures.py runway     one of them

Of each scene a few metres are simulated; everything comes from what ``roadscan simulate`` writes: the truth, the raw
logs, the pictures of the camera.
"""

from __future__ import annotations

import csv
import io
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from scipy.spatial.transform import Rotation, Slerp

from roadscan.simulate import Scene, simulate, truth
from roadscan.simulate.path import Earth
from roadscan.simulate.scene import Mount, shipped_scenes

Float64 = npt.NDArray[np.float64]

PICTURES: Final = Path(__file__).resolve().parent / "pictures"
INK, WARM, COOL, LEAF = "#333333", "#d1495b", "#00798c", "#3d8b40"
COLOURS: Final = {
    "ground": "#9aa0a6", "facade": "#8c6d4f", "tree": LEAF, "parked_car": WARM, "moving_car": "#f4a259",
    "guardrail": COOL, "sign": "#7b2d8b", "pole": "#2b6cb0", "lamp_post": "#1f3a5f", "fence": "#b0852f",
    "box": "#c2185b", "wall": "#7a6a58", "target": "#000000",
}  # fmt: skip


@dataclass(frozen=True)
class View:
    """Where of a scene pictures are taken."""

    station_m: float
    """Where the few metres begin that are simulated."""
    offset_m: float
    detail_m: tuple[float, float]
    """Stations of the detailed plan."""
    driven_m: float = 6.0
    """How far is driven from there."""
    profile_share: float = 0.5
    """Which profile is shown, as a share of all."""
    detail_reach_m: float = 9.0
    """Offsets of the detailed plan."""
    raised_m: tuple[float, float] = (9.0, 5.0)
    """How far behind and above the vehicle the perspective is seen from."""


VIEWS: Final = {
    "demo": View(8.0, 1.75, (10.0, 45.0)),
    "low_cost_rig": View(60.0, 1.6, (85.0, 125.0)),
    "reference_site": View(98.0, 1.9, (86.0, 126.0)),
    "calibration_yard": View(30.0, 0.0, (26.0, 54.0), 13.0, 12.28 / 13.0, 8.0, (5.0, 5.0)),
    "urban_street": View(70.0, 1.6, (85.0, 115.0)),
    "highway_three_lanes": View(20.0, 0.0, (85.0, 125.0), raised_m=(12.0, 6.0)),
    "street_with_cameras": View(20.0, 1.6, (30.0, 65.0)),
    "street_without_gnss": View(20.0, 1.6, (10.0, 60.0)),
    "runway": View(4.0, 6.0, (0.0, 110.0), detail_reach_m=27.0, raised_m=(16.0, 10.0)),
}


@dataclass(frozen=True)
class Survey:
    """A simulated survey, as it lies in its folder."""

    known: truth.Truth
    folder: Path

    @property
    def scene(self) -> Scene:
        """What was simulated."""
        return self.known.scene

    def poses(self, epoch_gps_ns: npt.NDArray[np.int64]) -> tuple[Float64, Rotation]:
        """True positions (n, 3) and attitudes of the body, ECEF."""
        rows = pq.read_table(self.known.trajectory_file("run-1"))
        epochs, first = rows["epoch_gps_ns"].to_numpy(), int(rows["epoch_gps_ns"][0].as_py())
        at = np.stack([rows[f"{a}_world_m"].to_numpy() for a in "xyz"], axis=-1)
        body = Rotation.from_quat(np.stack([rows[f"q{a}"].to_numpy() for a in "xyzw"], axis=-1))
        time, known = (epoch_gps_ns - first) / 1e9, (epochs - first) / 1e9
        position = np.stack([np.interp(time, known, column) for column in at.T], axis=-1)
        return position, Slerp(known, body)(time)

    def on_map(self, ecef_m: Float64) -> Float64:
        """Easting, northing, height (n, 3)."""
        return Earth(self.scene.map.crs).map_from_ecef(ecef_m)

    def path(self, run: str) -> Float64:
        """True way of the vehicle (n, 3) on the map."""
        rows = pq.read_table(self.known.trajectory_file(run), columns=["x_world_m", "y_world_m", "z_world_m"])
        return self.on_map(np.stack([column.to_numpy() for column in rows.columns], axis=-1)[::20])

    def objects(self) -> list[dict[str, Any]]:
        """What stands and moves beside the road."""
        rows: list[dict[str, Any]] = pq.read_table(self.known.objects_file).to_pylist()
        return rows

    def picture(self) -> npt.NDArray[np.uint8]:
        """The first picture of the camera."""
        file = self.folder / "raw/run-1/camera/000000.jpg"
        return np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def main(names: list[str]) -> None:
    """Write the pictures of some scenes, or of all."""
    mpl.use("Agg")
    plt.rcParams.update({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6})
    for name in names or list(shipped_scenes()):
        with tempfile.TemporaryDirectory() as folder:
            draw(name, Path(folder))
        print(f"drew {name}")


def draw(name: str, folder: Path) -> None:
    """Simulate a scene, as far as its pictures need it, and draw them."""
    scene, view = Scene.load(name), VIEWS[name]
    off: dict[str, Any] = {
        sensor: {"on": False} for sensor in ("lidar", "sick", "imu", "gnss", "encoder", "camera", "bag")
    }
    off["profilers"] = {"on": False, "head_imus": None}
    whole = write(scene.changed(**off), folder / "whole")
    save(plan_figure(whole, view), f"{name}-plan")
    piece = {"station_m": view.station_m, "offset_m": view.offset_m}
    stretch = scene.changed(
        passes=[{"route": piece | {"pieces": [{"length_m": view.driven_m}]}}],
        vehicle={"standstill_s": 0.0, "wander_m": 0.0},
        profilers={"spacing_m": 0.1},
        camera={"on": True, "every_m": 100.0},
    )
    recorded = write(stretch, folder / "stretch", hits=True)
    save(sensors_figure(recorded, view), f"{name}-sensors")
    behind, above = view.raised_m
    mount = Mount(lever_arm_body_m=(-behind, 0.0, -above), pitch_deg=-14.0)
    camera = {"on": True, "mount": mount.model_dump(), "focal_px": 760.0, "distortion": [0.0] * 5, "range_max_m": 200.0}
    raised = write(stretch.changed(**(off | {"camera": camera})), folder / "raised")
    both = np.concatenate([raised.picture(), recorded.picture()], axis=1)
    small = cv2.resize(both, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path_of(f"{name}-views")), small, [cv2.IMWRITE_JPEG_QUALITY, 82])


def write(scene: Scene, folder: Path, *, hits: bool = False) -> Survey:
    """Simulate a scene."""
    made = simulate(scene, folder, write_hits=hits)
    return Survey(truth.load(made.folder), made.folder)


def path_of(name: str) -> Path:
    """File of a picture."""
    return PICTURES / f"simulator-{name}.jpg"


def save(figure: Figure, name: str) -> None:
    """Write a figure as a small JPEG."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="rgba", dpi=figure.dpi)
    width, height = figure.canvas.get_width_height()
    rgba = np.frombuffer(drawn.getvalue(), np.uint8).reshape(height, width, 4)
    cv2.imwrite(str(path_of(name)), np.ascontiguousarray(rgba[:, :, 2::-1]), [cv2.IMWRITE_JPEG_QUALITY, 82])
    plt.close(figure)


# --- plan --------------------------------------------------------------------------------------------


def plan_figure(survey: Survey, view: View) -> Figure:
    """The whole scene on the map, turned so that stations grow to the right, and a piece of it closer."""
    figure, (whole, detail) = plt.subplots(
        2, 1, figsize=(9.6, 6.0), dpi=100, gridspec_kw={"height_ratios": [1.0, 1.0]}, layout="constrained"
    )
    draw_whole(whole, survey)
    draw_detail(detail, survey, view)
    kinds = {one["kind"] for one in survey.objects()}
    marks = [Patch(color=colour, label=kind.replace("_", " ")) for kind, colour in COLOURS.items() if kind in kinds]
    if marks:
        figure.legend(handles=marks, frameon=False, fontsize=7, loc="outside lower center", ncols=len(marks))
    return figure


def draw_whole(axes: Axes, survey: Survey) -> None:
    """Ground, objects, passes and control points of the whole scene."""
    surface, scene = survey.known.surface, survey.scene
    stations = np.linspace(-8.0, scene.length_m + 8.0, 200)
    line = np.stack(surface.place(stations, np.zeros(200))[:2], axis=-1)
    ahead = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    turn = np.array([ahead, [-ahead[1], ahead[0]]])  # rows: along, to the left
    origin = np.array([scene.map.easting_m, scene.map.northing_m])

    def turned(points: Float64) -> Float64:
        out: Float64 = (np.asarray(points)[..., :2] - origin) @ turn.T
        return out

    reach = scene.road.edge_m + 1.0
    margin = np.array([0.0, reach])
    low, high = turned(line).min(axis=0) - margin, turned(line).max(axis=0) + margin
    step = max((high[0] - low[0]) / 1800, 0.05)
    x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
    e, n = (origin + np.stack([x, y], axis=-1) @ turn)[..., :2].transpose(2, 0, 1)
    show_ground(axes, survey, e, n, step, (low[0], high[0], low[1], high[1]), 4.0)
    for one in survey.objects():
        draw_object(axes, one, turned)
    side = scene.roadside
    for kind, listed in (("guardrail", side.guardrails), ("fence", side.fences), ("facade", side.facades)):
        for barrier in listed:
            along = np.linspace(barrier.start_m, barrier.end_m, 100)
            along = along[(along > stations[0]) & (along < stations[-1])]
            line = turned(np.stack(surface.place(along, np.full(along.size, barrier.offset_m))[:2], axis=-1))
            axes.plot(line[:, 0], line[:, 1], color=COLOURS[kind], lw=1.6)
    for number in range(len(scene.passes)):
        way = turned(survey.path(f"run-{number + 1}"))
        axes.plot(way[:, 0], way[:, 1], lw=0.9, color=("#ffb000", "#4cc9f0", "#f72585", "#b8f35b")[number % 4])
        axes.annotate(
            f"{number + 1}", way[0], (-4 - 7 * number, 0), textcoords="offset points", color=INK, fontsize=7, ha="right"
        )
    with (survey.folder / "control.csv").open(encoding="utf-8") as rows:
        for row in csv.DictReader(rows):
            place = turned(np.array([float(row["easting_m"]), float(row["northing_m"])]))
            axes.plot(*place, marker="^" if row["role"] == "gcp" else "s", ms=4, mfc="white", mec=INK, mew=0.8)
    axes.set(xlim=(low[0] - 4, high[0] + 4), aspect="equal", xlabel="m", ylabel="m, to the left")
    axes.set_title(
        f"{scene.id}: height-shaded intensity; passes by number, control ▲, check ■, objects", loc="left", fontsize=8
    )


def draw_detail(axes: Axes, survey: Survey, view: View) -> None:
    """A piece in station and offset."""
    stations, reach = view.detail_m, min(survey.scene.road.edge_m, view.detail_reach_m)
    step = (stations[1] - stations[0]) / 1600
    s, o = np.meshgrid(np.arange(*stations, step), np.arange(-reach, reach, step))
    e, n, _ = survey.known.surface.place(s, o)
    extent = (stations[0], stations[1], reach, -reach)
    show_ground(axes, survey, e, n, step, extent, 8.0, first_row_up=True)

    def turned(points: Float64) -> Float64:
        return np.stack(survey.known.station_offset_m(points[..., 0], points[..., 1]), axis=-1)

    for one in survey.objects():
        if stations[0] < one["station_m"] < stations[1] and abs(one["offset_m"]) < reach:
            draw_object(axes, one, turned)
    axes.set(xlim=stations, ylim=(reach, -reach), aspect="equal", xlabel="station (m)", ylabel="offset (m)")
    axes.set_title("a piece of it, closer", loc="left", fontsize=8)


def show_ground(
    axes: Axes,
    survey: Survey,
    e: Float64,
    n: Float64,
    step_m: float,
    extent: tuple[float, float, float, float],
    exaggerated: float,
    *,
    first_row_up: bool = False,
) -> None:
    """Intensity times hillshade."""
    height = survey.known.surface.height_m(e, n, texture=False)
    relief = height if first_row_up else height[::-1]
    light = LightSource(azdeg=315, altdeg=40).hillshade(relief, vert_exag=exaggerated, dx=step_m, dy=step_m)
    grey = survey.known.intensity(e, n)
    grey = (grey if first_row_up else grey[::-1]) / 255.0
    shown = np.clip(grey**0.8 * (0.45 + 0.85 * light), 0.0, 1.0)
    rgba = np.dstack([shown, shown, shown, np.isfinite(relief).astype(float)])
    rows, columns = rgba.shape[0] // 2, rgba.shape[1] // 2
    mean = np.nan_to_num(rgba)[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 4).mean(axis=(1, 3))
    axes.imshow(mean, extent=extent, interpolation="hanning", aspect="auto")


def draw_object(axes: Axes, one: dict[str, Any], turned: Any) -> None:
    """Outline of an object from above, where it does not follow the road."""
    heading = np.radians(one["heading_deg"])
    along = np.array([np.sin(heading), np.cos(heading)])
    right = np.array([np.cos(heading), -np.sin(heading)])
    foot, colour = np.array([one["easting_m"], one["northing_m"]]), COLOURS[one["kind"]]
    if one["kind"] in {"guardrail", "fence", "facade"}:
        return
    half = one["length_m"] / 2 * along, one["width_m"] / 2 * right
    corners = [foot + i * half[0] + j * half[1] for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    if one["kind"] == "tree":
        circle = np.linspace(0, 2 * np.pi, 24)[:, None]
        corners = list(foot + one["length_m"] / 2 * (np.cos(circle) * along + np.sin(circle) * right))
    axes.add_patch(Polygon(turned(np.array(corners)), fc=colour, ec="none", alpha=0.75))
    if min(one["length_m"], one["width_m"]) < 0.3:
        axes.plot(*turned(foot), marker=".", ms=4, color=colour)


# --- sensors -----------------------------------------------------------------------------------------


def sensors_figure(survey: Survey, view: View) -> Figure:
    """One profile of both heads over the truth, where the rig has them, and one turn of the lidar."""
    figure = plt.figure(figsize=(9.6, 5.2), dpi=100, layout="constrained")
    profiled = survey.scene.profilers.on
    grid = figure.add_gridspec(2, 1 + profiled, width_ratios=[1.0, 1.35] if profiled else None)
    if profiled:
        draw_profile(figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0]), survey, view.profile_share)
    draw_turn(figure.add_subplot(grid[0, -1]), figure.add_subplot(grid[1, -1]), survey)
    figure.legend(frameon=False, markerscale=6, fontsize=7, loc="outside lower right", ncols=9)
    return figure


def draw_profile(shape: Axes, error: Axes, survey: Survey, share: float) -> None:
    """Cross-section as both heads measured it, brought to the map with the true poses and mountings."""
    for head, colour in (("left", COOL), ("right", WARM)):
        at = measured(survey, head, share)
        true = survey.known.height_m(at[:, 0], at[:, 1])
        station, offset = survey.known.station_offset_m(at[:, 0], at[:, 1])
        base = survey.known.surface.points_at(station[:1], np.zeros(1))[0, 2]
        order = np.argsort(offset)
        shape.plot(offset[order], 1e3 * (true - base)[order], color="#bbbbbb", lw=5.0, label="_")
        shape.plot(offset, 1e3 * (at[:, 2] - base), ".", ms=1.5, color=colour, label="_")
        error.plot(offset, 1e3 * (at[:, 2] - true), ".", ms=1.2, color=colour)
    shape.set(ylabel="height above the reference line (mm)")
    shape.set_title("one profile, left and right head, over the truth of the road (grey)", loc="left", fontsize=8)
    top = np.nanmax([np.max(np.asarray(line.get_ydata())) for line in error.lines])
    error.set(xlabel="offset (m)", ylabel="measured − truth (mm)", ylim=(-4, max(4, 1.1 * top)))


def measured(survey: Survey, head: str, share: float) -> Float64:
    """Map points (n, 3) of one profile of a head, from its raw log."""
    log = pq.ParquetFile(survey.folder / f"raw/run-1/profiler_{head}.parquet")
    geometry = json.loads(log.schema_arrow.metadata[b"roadscan.scan_geometry"])
    rows = log.read()
    number = round(share * (rows.num_rows - 1))
    units = np.array(rows["range"][number].as_py())
    points = np.zeros((units.size, 3))
    points[:, 1] = geometry["first"] + geometry["step"] * np.arange(units.size)
    points[:, 2] = geometry["range_offset_m"] + geometry["range_step_m"] * units
    mount: Mount = getattr(survey.scene.profilers, head)
    true = pq.read_table(survey.known.hits_file("run-1", f"profiler_{head}"), columns=["epoch_gps_ns"])
    position, body = survey.poses(true["epoch_gps_ns"].to_numpy()[[number]])
    turn = Rotation.from_euler("ZYX", [mount.heading_deg, mount.pitch_deg, mount.roll_deg], degrees=True)
    ecef = position + body.apply(turn.apply(points) + np.array(mount.lever_arm_body_m))
    return survey.on_map(ecef)[units > 0]


def draw_turn(top: Axes, side: Axes, survey: Survey) -> None:
    """The points of a tenth of a second around the vehicle, by what they lie on."""
    hits = pq.read_table(survey.known.hits_file("run-1", "lidar"))
    epochs = hits["epoch_gps_ns"].to_numpy()
    begin = int(np.median(epochs))
    one = (epochs >= begin) & (epochs < begin + round(1e9 / survey.scene.lidar.turns_per_s))
    enh = np.stack([hits[c].to_numpy()[one] for c in ("easting_m", "northing_m", "height_m")], axis=-1)
    kinds = {o["object_id"]: o["kind"] for o in survey.objects()} | {0: "ground"}
    kind = np.array([kinds[i] for i in hits["object_id"].to_numpy()[one].tolist()])
    ecef, _ = survey.poses(np.array([begin, begin + 100_000_000]))
    here, later = survey.on_map(ecef)
    ahead = (later - here)[:2] / np.linalg.norm((later - here)[:2])
    moved = enh[:, :2] - here[:2]
    x, y = moved @ ahead, moved @ np.array([-ahead[1], ahead[0]])
    z = enh[:, 2] - here[2] + survey.scene.vehicle.imu_height_m
    for name in sorted(set(kind), key=lambda k: -int((kind == k).sum())):
        mine = kind == name
        label = name.replace("_", " ")
        top.plot(x[mine], y[mine], ".", ms=1.1, color=COLOURS[name])
        side.plot(x[mine], z[mine], ".", ms=1.1, color=COLOURS[name], label=label)
    top.plot([-2.3, 2.2, 2.2, -2.3, -2.3], [0.9, 0.9, -0.9, -0.9, 0.9], color=INK, lw=0.8)
    top.plot([1.2, 2.2, 1.2], [0.5, 0.0, -0.5], color=INK, lw=0.8)
    top.set(aspect="equal", ylabel="to the left (m)")
    top.set_title("one turn of the lidar, from above and from the right", loc="left", fontsize=8)
    side.set(
        aspect="equal",
        xlabel="ahead (m)",
        ylabel="up (m)",
        xlim=top.get_xlim(),
        ylim=(min(-1.0, z.min()), max(3.0, z.max() + 0.5)),
    )


if __name__ == "__main__":
    main(sys.argv[1:])
