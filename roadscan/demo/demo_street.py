"""The demo's inventory: a short street is surveyed in spring and in autumn, and a person edits an asset between."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from roadscan.core.counted import counted
from roadscan.inventory.changes import Change
from roadscan.inventory.of_survey import open_inventory
from roadscan.run.session import Session
from roadscan.simulate import Scene, simulate

SPRING: Final = "2026-spring"
AUTUMN: Final = "2026-autumn"
STAGES: Final = ("ingest", "navigate", "footprints", "assets")
_STARTS: Final = {SPRING: "2026-05-04T10:30:00Z", AUTUMN: "2026-10-05T10:30:00Z"}
_KIND, _LAYER, _ATTRIBUTE, _VALUE = "pole", "poles", "asset_height_m", 3.0
"""What the person states: the height of a pole as its maker gives it."""
_SURVEY: Final = """
[assets]
kinds = ["pole", "sign"]
exports = []
classified = false
bare_earth = false

[inventory]
store = "../inventory"
name = "street"
epoch = "{epoch}"
home = "../inventory.gpkg"
"""


def street(epoch: str) -> Scene:
    """30 m of a straight street with poles on its right and signs on its left, as a survey epoch finds it.

    In autumn a pole is gone, another one stands 1.2 m farther on, a sign is new, and a hoarding hides a third pole.
    """
    is_autumn = epoch == AUTUMN
    stations = [4.0, 17.2, 22.0, 28.0] if is_autumn else [4.0, 10.0, 16.0, 22.0, 28.0]
    poles = [{"station_m": s, "offset_m": 7.5, "height_m": 3.0, "diameter_m": 0.12} for s in stations]
    signs = [{"station_m": s, "offset_m": -7.0} for s in ([7.0, 13.0, 19.0, 25.0] if is_autumn else [7.0, 13.0, 25.0])]
    hoarding = {"station_m": 22.0, "offset_m": 6.5, "length_m": 8.0, "width_m": 0.3, "height_m": 3.6}
    off = {key: {"on": False} for key in ("profilers", "sick", "imu", "gnss", "encoder", "camera")}
    return Scene.load("demo").changed(
        id="street", title="30 m of a street with poles and signs", start=_STARTS[epoch], length_m=30.0,
        seed=2 if is_autumn else 1, passes=[{"lane": 2, "direction": "forward"}],
        road={"alignment": [{"kind": "straight", "length_m": 200.0}], "waves": [], "ruts": [], "potholes": [],
              "cracks": [], "markings": [], "verge_width_m": 8.0},
        roadside={"poles": poles, "signs": signs, "boxes": [hoarding] if is_autumn else []},
        lidar={"range_max_m": 25.0}, **off,
    )  # fmt: skip


def prepare_street(folder: Path, epoch: str, report: Callable[[str], None]) -> Path:
    """Write the raw logs of an epoch, unless they are there; returns the survey file."""
    survey_file = folder / epoch / "SURVEY.toml"
    if survey_file.exists():
        return survey_file
    report(f"simulating the street's survey '{epoch}' into {survey_file.parent}")
    simulate(street(epoch), survey_file.parent, progress=report)
    with survey_file.open("a", encoding="utf-8") as file:
        file.write(_SURVEY.format(epoch=epoch))
    return survey_file


@dataclass(frozen=True)
class HandEdit:
    """What a person changed."""

    asset_id: str
    attribute: str
    found: float
    """As it was found before."""
    given: float


def edit_by_hand(survey_file: Path) -> HandEdit:
    """Publish the inventory, change one value of its GeoPackage as a person does in QGIS, and pull it."""
    inventory = open_inventory(Session.open(survey_file))
    inventory.publish()
    rows = inventory.assets(_KIND).sort_values("station_m")
    asset_id = str(rows["asset_id"].iloc[0])
    found = inventory.state().row(asset_id, evidence=True) or {}
    write_height(inventory.home.name, asset_id)
    inventory.pull(who="demo", why="the height of its maker's list")
    return HandEdit(asset_id, _ATTRIBUTE, float(found[_ATTRIBUTE]), _VALUE)


def write_height(file: str, asset_id: str) -> None:
    """Write the height of a pole into its layer of a home, as QGIS does it: through GDAL."""
    import pyogrio

    layer = pyogrio.read_dataframe(file, layer=_LAYER, fid_as_index=True)
    layer.loc[layer["asset_id"] == asset_id, _ATTRIBUTE] = _VALUE
    pyogrio.write_dataframe(
        layer, file, layer=_LAYER, driver="GPKG", append=False, geometry_type="Point Z",
        layer_options={"GEOMETRY_NAME": "geom"},
    )  # fmt: skip


def compare_epochs(survey_file: Path, edit: HandEdit) -> list[str]:
    """Publish the second epoch; lines that say what changed on the street, and whether the edit is in force."""
    inventory = open_inventory(Session.open(survey_file))
    shown = inventory.publish()
    changes = inventory.changes()
    row = inventory.state().row(edit.asset_id) or {}
    evidence = inventory.state().row(edit.asset_id, evidence=True) or {}
    is_in_force = row.get(edit.attribute) == edit.given
    lines = [f"inventory     {shown.home}: {shown.assets} assets of {SPRING} and {AUTUMN}"]
    if changes is not None:
        lines += [f"on the street {line}" for line in _told(changes.changes)]
        unseen = counted(changes.unseen, "asset")
        lines.append(f"not in sight  {unseen}: the second survey says nothing of it, so it counts as there")
    lines.append(
        f"hand edit     {edit.asset_id}: {edit.attribute} {row.get(edit.attribute):.2f}, "
        f"{'in force' if is_in_force else 'not in force'}; found {edit.found:.2f} before it and "
        f"{evidence[edit.attribute]:.2f} since"
    )
    return lines


def _told(changes: tuple[Change, ...]) -> Iterator[str]:
    """Changes of the street in words; values that were measured anew are left out."""
    for one in changes:
        words: dict[str, Any] = {
            "appeared": "appeared",
            "gone": f"missing: {one.passes_expected} pass should have seen it",
            "moved": f"moved by {one.distance_m or 0.0:.2f} m",
        }
        if one.change in words:
            yield f"{one.asset_id}: {words[one.change]}"
