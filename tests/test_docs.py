"""Documentation: generated pages are current, links lead somewhere, and every example runs."""

from __future__ import annotations

import datetime as dt
import functools
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import laspy
import numpy as np
import pandas as pd
import pyogrio
import pytest
import rasterio
from typer.testing import CliRunner

from docs import generate
from roadscan.assets.kind import asset_kinds, table_of_objects
from roadscan.assets.scene import Box, GroundModel, Returns, Scene
from roadscan.cli import app
from roadscan.condition.index import condition_indices
from roadscan.condition.lane_data import LaneData, Profile
from roadscan.core.crs import MapFrame
from roadscan.core.errors import StoreError
from roadscan.core.gpstime import Clock, TimeSystem, gps_ns_from_utc
from roadscan.core.grid import TileGrid, TileId
from roadscan.core.survey import Survey, survey_file_model
from roadscan.ingest.reading.format import LogSource, Reject, Rows, format_of, log_formats
from roadscan.ingest.sources import claims_digest
from roadscan.report.section import sections
from roadscan.run.session import Session
from roadscan.run.stage import stages
from roadscan.site.layer import layer_kinds
from roadscan.site.material import Material
from roadscan.store.asset_schema import _files, asset_schema, asset_tables
from roadscan.store.query.sql import query
from roadscan.store.schema import _schema_files, table_schema
from roadscan.survey.status import survey_status, verify_store
from roadscan.tiles.cells import TileCells
from roadscan.tiles.product import ProductContext, SurveyProduct, Tile, TileProduct, product_named, products
from tests.house import figures
from tests.surveys import Simulated

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


# --- pages --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_generated_pages_are_current() -> None:
    assert generate.stale(generate.pages()) == [], "run `make docs` and commit the result"


def test_a_changed_page_is_noticed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(generate, "DOCS", tmp_path / "docs")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text("old")
    monkeypatch.setattr(generate, "pages", lambda: {tmp_path / "docs" / "page.md": "new"})
    assert generate.main(["--check"]) == 1
    assert generate.main([]) == 0
    assert (tmp_path / "docs" / "page.md").read_text() == "new"
    assert generate.main(["--check"]) == 0


def test_tables_page_holds_every_column() -> None:
    page = (ROOT / "docs" / "tables.md").read_text()
    sections = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", page, flags=re.MULTILINE | re.DOTALL))
    for name in generate.schema_names():
        listed = re.findall(r"^\| `(\w+)` \|", sections[name], flags=re.MULTILINE)
        assert listed == [c.name for c in table_schema(name).columns]


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def links(page: Path) -> list[str]:
    """Targets of a page's links, in order."""
    return re.findall(r"\]\(([^)\s]+)\)", page.read_text())


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in links(page):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), target
        if anchor:
            assert anchor in anchors(there), target


SOURCES = [
    file.relative_to(ROOT)
    for folder in ("roadscan", "tests", "docs", "examples", "benchmarks", "flows", "schemas", "fuzzed", "deploy")
    for file in (ROOT / folder, *(ROOT / folder).rglob("*"))
]
FEATURES = {file.parts[1] for file in SOURCES if file.parts[0] == "roadscan" and len(file.parts) > 2}
PLACEHOLDER = re.compile(r"\b[A-Z]+\b")
"""A word that stands for a name, as NAME in `roadscan/formats/NAME.py`."""


def missing(text: str, *, by_feature: bool) -> set[str]:
    """Return what a page names in backticks that is no file or folder: names of Python files, and paths of folders.

    With `by_feature` a file named without its folder has to lie in a feature that its section names, or in no feature.
    A path such as `demo/street/`, below a folder that the demo writes, is no folder of the library.
    """
    found = set()
    for section in re.split(r"^(?=## )", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), flags=re.M):
        named = set(re.findall(r"\w+", section)) & FEATURES
        for name in re.findall(r"`([\w./-]+)`", section):
            parts = tuple(PLACEHOLDER.sub("*", part) for part in Path(name).parts)
            is_folder = name.endswith("/") and parts[0] in {"roadscan", "tests"} | FEATURES - {"demo"}
            if not (name.endswith(".py") or is_folder or name.startswith(("roadscan/", "tests/"))):
                continue
            if not any(
                file.match("/".join(parts))
                and (len(parts) > 1 or not by_feature or file.parts[0] != "roadscan" or {*file.parts[1:2]} <= named)
                for file in SOURCES
            ):
                found.add(name)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_that_a_page_names_exist(page: Path) -> None:
    """The changelog tells of the past and is left out."""
    if page.name != "CHANGELOG.md":
        assert missing(page.read_text(), by_feature=page.name == "architecture.md") == set()


def test_a_file_that_is_gone_is_noticed() -> None:
    text = (
        "## Of tiles\n`tiles/cells.py`, `tiles/cellz.py`, `tiles/nowhere/`, `tests/core`, `tests/kore`, `superseded/`"
    )
    gone = {"tiles/cellz.py", "tiles/nowhere/", "tests/kore"}
    assert missing(text, by_feature=False) == gone
    assert missing(text + ", `caster.py`", by_feature=False) == gone
    assert missing(text + ", `caster.py`", by_feature=True) == {*gone, "caster.py"}  # it lies in simulate


def test_every_page_is_linked_from_the_index() -> None:
    index = ROOT / "docs" / "index.md"
    linked = {(index.parent / target.partition("#")[0]).resolve() for target in links(index)}
    pages = {page for page in PAGES if page.parent == index.parent and page != index}
    assert sorted(page.name for page in pages - linked) == []


def test_the_glossary_is_in_order_and_explains_the_terms_that_it_names() -> None:
    text = (ROOT / "docs" / "glossary.md").read_text()
    terms = re.findall(r"^\*\*(.+?)\.\*\*", text, flags=re.MULTILINE)
    keys = [term.replace("σ (sigma)", "sigma").lower() for term in terms]
    assert len(terms) >= 40
    assert keys == sorted(keys)
    explained = {term.lower() for term in terms} | {"body"}
    named = {re.sub(r"\s+", " ", name).lower() for name in re.findall(r"(?<!\*)\*([^*]+)\*(?!\*)", text)} - {"italics"}
    assert {name for name in named if name not in explained and name.removesuffix("s") not in explained} == set()


def test_files_for_gis_open_as_the_page_says(
    finished: Simulated,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page = (ROOT / "docs" / "qgis.md").read_text()
    store = finished.copy_with_store_to(tmp_path / "demo").survey_file.parent / "store" / "survey=demo"
    kinds = {"GTiff": 0, "las": 0}
    table = "\n".join(line for line in page.splitlines() if line.startswith("| "))
    for name in re.findall(r"`((?:products|tiles)/[\w/]+\.(?:tif|laz))`", table):
        files = sorted(store.glob(name.replace("COLUMN_ROW", "*")))
        assert files, name
        if name.endswith(".tif"):
            with rasterio.open(files[0]) as raster:
                kinds[raster.driver] += 1
                assert raster.crs.to_epsg() == 32632
                assert raster.tags()["ROADSCAN_HEIGHT"] == "ellipsoidal"
                assert raster.count == (3 if "geotiff" in name else 1)
        else:
            with laspy.open(files[0]) as points:
                kinds["las"] += 1
                assert points.header.parse_crs().to_2d().to_epsg() == 32632
    assert kinds == {"GTiff": 4, "las": 1}
    monkeypatch.chdir(store.parent.parent)
    for example in re.findall(r"^```python\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL):
        exec(compile(example, "docs/qgis.md", "exec"), {})
    layer = pyogrio.read_info("tiles.gpkg", layer="tiles")
    assert (layer["geometry_type"], layer["crs"]) == ("Polygon", "EPSG:32632")
    assert "tile" in layer["fields"]


def test_readme_lists_every_format_and_product() -> None:
    tables = dict(re.findall(r"^\| (in|out) \|.*?\n((?:\|.*\n)+)", (ROOT / "README.md").read_text(), re.MULTILINE))
    assert log_formats().keys() - set(re.findall(r"`(\w+)`", tables["in"])) == set()
    assert products().keys() == set(re.findall(r"`(\w+)`", tables["out"]))


@pytest.mark.slow
def test_readme_questions_to_the_demo_have_answers(
    finished: Simulated,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    finished.copy_with_store_to(tmp_path / "demo")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "README.md").read_text()
    section = page[page.index("\n## Questions in SQL and Python") : page.index("\n## A survey with known truth")]
    questions = re.findall(r"^roadscan (sql .*)$", section, flags=re.MULTILINE)
    assert len(questions) == 3
    for question in questions:
        outcome = CliRunner().invoke(app, shlex.split(question))
        assert outcome.exit_code == 0, outcome.output
        assert len(outcome.stdout.splitlines()) > 2
    names: dict[str, Any] = {}
    for example in re.findall(r"^```python\n(.*?)^```", section, flags=re.MULTILINE | re.DOTALL):
        exec(compile(example, "README.md", "exec"), names)
    assert names["tiles"].points.sum() == names["cells"].points.sum() > 0
    assert names["log"].format == "scans"


# --- the worked examples ------------------------------------------------------------------------


def test_the_complete_survey_and_rig_files_load() -> None:
    survey = Survey.load(ROOT / "docs" / "examples" / "SURVEY.toml")
    assert sorted(survey.rig.sensors) == ["camera", "left", "right", "roof"]
    assert {log.sensor for run in survey.config.runs for log in run.logs} == {None, "left", "roof"}
    assert set(survey.config.products.make or ()) <= set(products())
    for name, options in survey.config.products.options.items():
        product_named(name).options.parse(options)


@pytest.mark.slow
def test_a_survey_from_arrays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(ROOT / "docs" / "examples" / "survey_from_arrays.py"))
    outcome = CliRunner().invoke(app, ["run", "array-survey/SURVEY.toml", "--workers", "0"])
    assert outcome.exit_code == 0, outcome.output
    with rasterio.open("array-survey/store/survey=arrays/products/mosaic/height.tif") as raster:
        heights = raster.read(1)
        rows, columns = np.nonzero(np.isfinite(heights))
        easting, northing = rasterio.transform.xy(raster.transform, rows, columns)
    # Across the line of driving (to the north-east through 500000, 5300000), right positive.
    east, north = np.array(easting) - 500_000, np.array(northing) - 5_300_000
    across = (east - north) * np.sqrt(0.5)
    along = (east + north) * np.sqrt(0.5)
    expected = 100.0 - 0.012 * np.exp(-(((across - 0.8) / 0.2) ** 2))
    inside = (along > 5.3) & (along < 54.6)
    assert inside.sum() > 70_000
    # A cell is 5 cm wide and the rut's wall falls 5 cm a metre: half a cell is 1.3 mm at the steepest.
    assert np.abs(heights[rows, columns] - expected)[inside].max() < 0.0015


# --- the examples of CONTRIBUTING.md ------------------------------------------------------------


CONTRIBUTING = ROOT / "CONTRIBUTING.md"
BASES = (
    "LogFormat", "TileProduct", "SurveyProduct", "ConditionIndex", "AssetKind", "Stage", "SurveySection",
    "Section", "LayerKind"
)  # fmt: skip
GROUPS = {
    "formats": "roadscan.formats", "levels": "roadscan.stages", "assets/kinds": "roadscan.asset_kinds",
    "condition/indices": "roadscan.condition_indices",
    "tiles/products": "roadscan.products", "levels/settings": "roadscan.survey_sections",
    "report/sections": "roadscan.report_sections", "site/layers": "roadscan.site_layers",
}  # fmt: skip


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the library with the examples of the page in the places that it names."""
    folder = tmp_path_factory.mktemp("placed")
    shutil.copytree(ROOT / "roadscan", folder / "roadscan", ignore=shutil.ignore_patterns("__pycache__"))
    project, page = (ROOT / "pyproject.toml").read_text(), CONTRIBUTING.read_text()
    ((before, line),) = re.findall(r'^```toml\n# pyproject.toml, before ("\w+")\n(.*?)\n```', page, re.MULTILINE)
    assert project.count(f"  {before},\n") == 1
    (folder / "pyproject.toml").write_text(project.replace(f"  {before},\n", f"  {line}\n  {before},\n"))
    for name, text in re.findall(r"^```python\n# ([\w/]+\.py)\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        file = folder / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    return folder


@pytest.mark.slow
def test_the_examples_pass_the_checks_in_their_places(placed: Path) -> None:
    """Style, the order of imports, constants; a folder with code is a package, and one that the contracts know."""
    run = functools.partial(subprocess.run, cwd=placed, capture_output=True, text=True, check=False)
    programs = Path(sys.executable).parent
    for words in (["check"], ["format", "--check"]):  # the flows are the link's, with rules of their own
        outcome = run([str(programs / "ruff"), *words, "--no-cache", "--exclude", "roadscan/flows", "."])
        assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    assert packages_without_init(placed / "roadscan") == []
    command = [str(programs / "lint-imports"), "--no-logo", "--no-cache"]
    outcome = run(command, env={"PYTHONPATH": str(placed), "PATH": ""})
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    for name, text in re.findall(
        r"^```python\n# ([\w/]+\.py)\n(.*?)^```", CONTRIBUTING.read_text(), re.MULTILINE | re.DOTALL
    ):
        assert all(figures._constants(text)), name


def packages_without_init(library: Path) -> list[str]:
    """Folders with code that lint-imports and the wheel would not see as packages."""
    folders = {file.parent for file in library.rglob("*.py")}
    return sorted(folder.as_posix() for folder in folders if not (folder / "__init__.py").exists())


def test_every_folder_with_code_is_a_package(tmp_path: Path) -> None:
    assert packages_without_init(ROOT / "roadscan") == []
    (tmp_path / "levels").mkdir()
    (tmp_path / "__init__.py").touch()
    (tmp_path / "levels" / "stage.py").touch()
    assert packages_without_init(tmp_path) == [(tmp_path / "levels").as_posix()]


@pytest.fixture
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The examples, installed for one test as another package that adds them through entry points.

    It is not installed for the whole module: the shared survey, made by whichever test asks for it first, would then
    know of formats that the next tests do not have.
    """
    folder = tmp_path_factory.mktemp("plugin")
    blocks = re.findall(r"```python\n# roadscan/([\w/]+)/(\w+)\.py\n(.*?)```", CONTRIBUTING.read_text(), re.DOTALL)
    entries: dict[str, list[str]] = {}
    for group, file, code in blocks:
        if file == "__init__":
            continue
        module = f"{group}_{file}".replace("/", "_")
        text = code.replace("from roadscan.levels.settings", "from contributed_levels_settings")
        (folder / f"contributed_{module}.py").write_text(text)
        name = re.findall(rf"^class (\w+)\((?:{'|'.join(BASES)})\)", code, flags=re.MULTILINE)[0]
        entry = f"{group if file == 'stage' else file} = contributed_{module}:{name}"
        entries.setdefault(GROUPS.get(f"{group}/{file}") or GROUPS[group], []).append(entry)
    schemas = folder / "contributed_schemas"
    schemas.mkdir()
    (schemas / "__init__.py").touch()
    for name, text in re.findall(r"```toml\n# schemas/(\w+)\.toml\n(.*?)```", CONTRIBUTING.read_text(), re.DOTALL):
        (schemas / f"{name}.toml").write_text(text)
    (schemas / "assets").mkdir()
    for name, text in re.findall(
        r"```toml\n# schemas/assets/(\w+)\.toml\n(.*?)```", CONTRIBUTING.read_text(), re.DOTALL
    ):
        (schemas / "assets" / f"{name}.toml").write_text(text)
    entries["roadscan.schemas"] = ["contributed = contributed_schemas"]
    info = folder / "contributed-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: contributed\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("\n".join(f"[{g}]\n" + "\n".join(e) for g, e in entries.items()))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        _look_again()
        yield folder
    _look_again()


def _look_again() -> None:
    """Let what is installed be found anew."""
    for found in (
        claims_digest,
        log_formats,
        products,
        stages,
        survey_file_model,
        sections,
        condition_indices,
        layer_kinds,
        asset_kinds,
        asset_tables,
        asset_schema,
        _files,
        _schema_files,
        table_schema,
    ):
        found.cache_clear()


def test_the_contributed_format(plugin: Path, tmp_path: Path) -> None:
    start = dt.datetime(2026, 5, 4, 9, 30, tzinfo=dt.UTC)
    dtype = np.dtype([("stamp", "<i8"), ("xyz_m", "<f4", 3), ("intensity", "<u2"), ("laser", "u1")])
    records = np.zeros(5, dtype)
    records["stamp"] = int(start.timestamp()) * 10**6 + np.arange(5) * 50
    records["stamp"][2] = -(2**62)
    records["xyz_m"] = np.arange(15).reshape(5, 3)
    log = tmp_path / "drive.bin"
    log.write_bytes(b"BOXLOG1\0" + records.tobytes() + b"torn")

    reader = format_of(log)
    assert reader.name == "boxlog"
    source = LogSource(log, reader.options(), Clock(TimeSystem.UNIX_UTC, unit="us"))
    header = reader.header(source)
    items = list(reader.read(source, header))
    batches = [item.batch for item in items if isinstance(item, Rows)]
    rejects = [item for item in items if isinstance(item, Reject)]
    assert [(r.record, r.offset, r.records) for r in rejects] == [(2, 8 + 2 * 23, 1), (5, 8 + 5 * 23, 1)]
    rows = table_schema("returns").conform(batches[0])
    assert table_schema("returns").faults(rows) == []
    epochs = [gps_ns_from_utc(start) + i * 50_000 for i in (0, 1, 3, 4)]
    assert rows.column("epoch_gps_ns").to_pylist() == epochs
    assert rows.column("y_sensor_m").to_pylist() == [1.0, 4.0, 10.0, 13.0]


CONTEXT = ProductContext("demo", "", MapFrame("EPSG:25832"), TileGrid(10.0, 0.5), (), dt.date(2026, 5, 4))


def chessboard(tile: TileId, step_m: float) -> TileCells:
    """A full tile on a sloping plane whose cells stand alternately `step_m` above and below it."""
    edge = 20
    row, column = (a.ravel() for a in np.indices((edge, edge)))
    sign = np.where((row + column) % 2, 1.0, -1.0)
    height = 100.0 + 0.02 * column * 0.5 - 0.03 * row * 0.5 + sign * step_m
    ones = np.ones(edge * edge)
    return TileCells(
        tile=tile,
        cells_per_edge=edge,
        column=column.astype(np.uint16),
        row=row.astype(np.uint16),
        count=ones.astype(np.uint32),
        height_mean_m=height,
        height_robust_m=height,
        height_min_m=height,
        height_max_m=height,
        height_std_m=np.zeros(edge * edge, np.float32),
        intensity_mean=ones.astype(np.float32),
        pass_count=ones.astype(np.uint16),
        pass_offsets=np.arange(edge * edge + 1, dtype=np.int32),
        pass_ids=ones.astype(np.uint16),
    )


def test_the_contributed_product(plugin: Path, tmp_path: Path) -> None:
    product = product_named("heights_csv")
    assert isinstance(product, TileProduct)
    assert not product.default
    cells = chessboard(TileId(50_000, 530_000), 0.0)
    file = tmp_path / "heights.csv"
    product.write(Tile(None, cells), product.options.parse({"decimals": 3}), CONTEXT, file)  # type: ignore[arg-type]
    product.check(file)
    table = pd.read_csv(file)
    assert table.iloc[0].tolist() == [500_000.25, 5_300_000.25, 100.0]
    assert table.iloc[-1].tolist() == [500_009.75, 5_300_009.75, 99.905]  # 9.5 m · (0.02 − 0.03)
    file.write_text("easting_m,northing_m,height_m\n1,2,three\n")
    with pytest.raises(StoreError, match="not a table of heights"):
        product.check(file)


def test_the_contributed_index(plugin: Path) -> None:
    """Of a sine wave, slopes over b have the amplitude 2 A sin(π b / L) / b, and half its square as variance."""
    station = np.arange(0.0, 100.0, 0.05)
    height = 0.01 * np.sin(2.0 * np.pi * station / 5.0)
    path = Profile(station, np.column_stack([station, 0.0 * station]), height, np.full(station.size, 1e-4))
    config = SimpleNamespace(profile_spacing_m=0.05, least_share=0.9)
    lane = SimpleNamespace(
        sections_m=((0.0, 50.0), (200.0, 300.0)), profiles={"left": path, "right": path}, config=config
    )
    lane.paths_share = lambda *ends: LaneData.paths_share(lane, *ends)  # type: ignore[arg-type]
    known, beyond = condition_indices()["slope_variance"].values(lane)  # type: ignore[arg-type]
    amplitude = 2.0 * 0.01 * np.sin(np.pi * 0.25 / 5.0) / 0.25
    assert known.value == pytest.approx(1e6 * 0.5 * amplitude**2, rel=0.01)
    assert np.isnan(beyond.value) and beyond.reason == "0 % of the wheel paths were measured"


def test_the_contributed_product_over_tiles(plugin: Path, tmp_path: Path) -> None:
    product = product_named("flatness")
    assert isinstance(product, SurveyProduct)
    steps_m = {TileId(1, 1): 0.0, TileId(1, 2): 0.004, TileId(2, 1): None}
    output = product.outputs([], product.options(), CONTEXT)[0]
    output = type(output)(output.name, tuple(steps_m))
    file = tmp_path / output.name

    def load(tile: TileId) -> TileCells | None:
        step = steps_m[tile]
        return None if step is None else chessboard(tile, step)

    product.write(output, [], load, product.options(), CONTEXT, file)
    product.check(file)
    table = pd.read_csv(file)
    assert table.tile.tolist() == ["1_1", "1_2"]
    assert table.flatness_mm.tolist() == pytest.approx([0.0, 4.0], abs=1e-3)
    file.write_text("a,b\n")
    with pytest.raises(StoreError, match="not a table of flatness"):
        product.check(file)


def test_the_contributed_kind_of_assets(plugin: Path) -> None:
    kind, schema = asset_kinds()["overhang"], asset_schema("overhang")
    assert asset_tables()["overhangs"] == "overhang"
    height = np.array([0.0, 4.4, 3.1, 1.5, 2.8])
    ones = np.ones(5, np.uint8)
    returns = Returns(
        (700_000.0, 5_300_000.0), np.array([5.0, 5.0, 5.5, 5.0, 9.0]), np.full(5, 5.0), height,
        np.zeros(5, np.float32), np.arange(5) + 10**18, np.ones(5, np.uint16), 0 * ones, np.zeros(5, np.uint16), ones,
        ones, np.zeros(5), np.zeros(5), np.full(5, 2.0), ("roof",),
    )  # fmt: skip
    ground = GroundModel(0.0, 0.0, 1.0, np.zeros((10, 10), np.float32), np.ones((10, 10), bool))
    box, drive = Box(0.0, 0.0, 10.0, 10.0), np.array([[5.0, 0.0, 2.0, 1.0], [5.0, 5.0, 2.0, 1.0]])
    scene = Scene(returns, box, box, ground, height.astype(np.float32), ones, drive)
    pieces = kind.evidence(scene, kind.options()).pieces
    (found,) = kind.objects(pieces, kind.options(), {})
    rows = table_of_objects("overhang", [found], schema.arrow())
    assert rows["clearance_m"].to_pylist() == pytest.approx([3.1])  # the lower ones are ground, or beside the way
    assert rows["easting_m"].to_pylist() == [700_005.5]
    assert kind.evidence(replace(scene, drive_xyh_m=drive[:0]), kind.options()).pieces.num_rows == 0
    assert "overhang" not in generate.asset_list("")


@pytest.mark.slow
def test_contributed_formats_stay_off_the_pages(plugin: Path) -> None:
    assert "boxlog" in log_formats()
    assert "boxlog" not in generate.formats("")
    assert "flatness" not in generate.product_list("")


@pytest.mark.slow
def test_the_contributed_stage(plugin: Path, finished: Simulated, tmp_path: Path) -> None:
    survey = finished.copy_with_store_to(tmp_path / "survey").survey_file
    ends = ["levels", "pictures", "surfaces", "products", "condition", "assets", "colours"]
    assert [s.name for s in stages()][-7:] == ends

    def due() -> int:
        return survey_status(Session.open(survey)).of("levels").stale

    manifest = Session.open(survey).manifest
    manifest.remove(manifest.of("levels").values())  # the fixture's run knew the stage, if it came after the plugin
    held = len([r for r in Session.open(survey).manifest.of("tile").values() if r.path])
    assert due() == held
    assert "levels" in CliRunner().invoke(app, ["--help"]).output
    outcome = CliRunner().invoke(app, ["levels", str(survey), "--workers", "0"])
    assert outcome.exit_code == 0, outcome.output
    assert due() == 0
    rows = query(Session.open(survey).store, "SELECT tile, level_m, height_mean_m FROM levels JOIN tiles USING (tile)")
    assert rows.num_rows == held
    told = CliRunner().invoke(app, ["sql", "--survey", str(survey), "--csv", "SELECT count(*) FROM levels"])
    assert str(held) in told.output
    (file,) = {r.path for r in Session.open(survey).manifest.of("levels").values() if r.unit == rows["tile"][0].as_py()}
    Session.open(survey).store.write_bytes(file, b"damaged")
    assert any(file in fault for fault in verify_store(Session.open(survey).store))
    assert due() == 1


@pytest.mark.slow
def test_the_contributed_settings(plugin: Path, finished: Simulated, tmp_path: Path) -> None:
    """A section of the survey file of another package: checked, used, and part of the keys."""
    survey = finished.copy_with_store_to(tmp_path / "survey").survey_file
    assert CliRunner().invoke(app, ["levels", str(survey), "--workers", "0"]).exit_code == 0
    stated = survey.read_text(encoding="utf-8")
    survey.write_text(stated + '\n[levels]\nstatistics = "median"\n', encoding="utf-8")
    wrong = CliRunner().invoke(app, ["levels", str(survey), "--workers", "0"])
    assert "'levels.statistics' (did you mean 'statistic'?)" in str(wrong.exception)
    survey.write_text(stated + '\n[levels]\nstatistic = "median"\n', encoding="utf-8")
    assert survey_status(Session.open(survey)).of("levels").stale > 0
    assert CliRunner().invoke(app, ["levels", str(survey), "--workers", "0"]).exit_code == 0
    assert survey_status(Session.open(survey)).of("levels").stale == 0


@pytest.mark.slow
def test_the_contributed_section_and_layer(plugin: Path, finished: Simulated, tmp_path: Path) -> None:
    survey = finished.copy_with_store_to(tmp_path / "survey").survey_file
    assert CliRunner().invoke(app, ["levels", str(survey), "--workers", "0"]).exit_code == 0
    assert CliRunner().invoke(app, ["report", str(survey)]).exit_code == 0
    count = len(Session.open(survey).manifest.of("levels"))
    (report,) = (survey.parent / "store").rglob("report.html")
    assert f"{count:,} tiles have a level." in report.read_text(encoding="utf-8")
    (layer,) = (
        one for kind in layer_kinds() if kind.name == "levels" for one in kind.layers(Material(Session.open(survey)))
    )
    assert len(layer.rows) == count and layer.shapes_m[0].area == pytest.approx(100.0)
