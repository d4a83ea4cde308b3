"""What is large: a network of 1,000 km, and a table of hostile strings."""

from __future__ import annotations

import json
import math
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from roadscan.site.document import json_bytes
from roadscan.site.server import SiteServer
from roadscan.site.web_part import web_folder
from tests.serving import serving
from tests.viewer.conftest import FolderSite, go_to
from tests.viewer.network import APART_M, SOUTH_M, WEST_M, Network
from tests.viewer.street import HOSTILE

STRINGS = 10_000
ACROSS = 20


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Network:
    """The network, with the page."""
    folder = tmp_path_factory.mktemp("network")
    built = web_folder()
    if built is not None:
        shutil.copy(built / "index.html", folder)
        shutil.copytree(built / "app", folder / "app")
    return Network(folder)


def served(documents: Any) -> Iterator[str]:
    with serving(SiteServer(documents)) as server:
        yield server.address


@pytest.fixture(scope="module")
def network_address(network: Network) -> Iterator[str]:
    yield from served(network)


@pytest.mark.slow
def test_a_network_opens_as_a_street_does(open_page: Any, network: Network, network_address: str) -> None:
    with open_page(network_address) as watched:
        fetched = [0.0]
        client = watched.page.context.new_cdp_session(watched.page)
        client.send("Network.enable")
        client.on("Network.loadingFinished", lambda one: fetched.append(one["encodedDataLength"]))
        page = watched.open(network_address)
        page.wait_for_selector('.map-view[data-drawn="true"]')
        assert network.features > 150_000
        assert sum(fetched) <= 8e6
        # Each section of the network has its colour from far away; near it, its whole row.
        count = page.locator(".layer", has_text="Condition by section")
        assert count.locator(".entries li").count() == 6
        north_m = SOUTH_M + APART_M / 2 + 8.0 * math.sin(1e4 / 300.0)  # on the first road, 10 km from its beginning
        go_to(page, f"at={WEST_M + 1e4},{north_m}&zoom=300&views=map")
        page.wait_for_selector('.map-view[data-drawn="true"]')
        page.locator(".map-target").focus()
        page.keyboard.press("Enter")
        page.locator('.details dt:text-is("Section")').wait_for()
        assert page.evaluate("performance.memory.usedJSHeapSize") <= 500e6


def hostile_strings() -> list[str]:
    """Random texts of all planes of Unicode and of what has a meaning in HTML, a seventh of them whole attacks."""
    draw = random.Random(11)
    signs = "<>&\"'`=/\\;:()[]{}%#!-+ \t\n\r\0\x0b\x1b\u2028\u2029\u202e\ufeff𝒳éß漢🛣"
    attacks = (
        HOSTILE, "</script><script>window.hit=3</script>", "<svg onload=window.hit=4>", "javascript:window.hit=5",
        "{{constructor.constructor('window.hit=6')()}}", "<iframe srcdoc='<script>parent.hit=7</script>'>", "-->",
    )  # fmt: skip
    texts = []
    for number in range(STRINGS):
        text = "".join(draw.choice(signs) if draw.random() < 0.6 else chr(draw.randrange(32, 0xD7FF)) for _ in range(9))
        texts.append(f"{number} {text}{draw.choice(attacks) if number % 7 == 0 else ''}")
    return texts


@pytest.fixture
def strings_address(street: Path, tmp_path: Path) -> Iterator[str]:
    """The street with a layer whose rows are such texts."""
    texts = hostile_strings()
    site = tmp_path / "site"
    shutil.copytree(street, site, ignore=shutil.ignore_patterns("clouds", "pictures", "strips", "meshes"))
    survey = json.loads((site / "survey.json").read_text())
    survey |= dict.fromkeys(("clouds", "pictures", "strips", "meshes", "edits", "raster_grid")) | {"rasters": []}
    names = [f"c{k}" for k in range(ACROSS)]
    rows = [dict(zip(names, texts[at : at + ACROSS], strict=True)) for at in range(0, STRINGS, ACROSS)]
    layer = next(one for one in survey["layers"] if one["name"] == "asset_poles")
    columns = [{"name": n, "title": HOSTILE + n, "unit": "text", "meaning": HOSTILE} for n in names]
    layer |= {"columns": columns, "label": "c0", "key": "c1", "features": len(rows)}
    (pole,) = json.loads((site / layer["parts"][0]["url"]).read_text())["features"]
    features = [pole | {"id": n, "properties": row} for n, row in enumerate(rows)]
    (site / layer["parts"][0]["url"]).write_bytes(json_bytes({"features": features}))
    (site / "survey.json").write_bytes(json_bytes(survey))
    yield from served(FolderSite(site))


@pytest.mark.slow
def test_ten_thousand_strings_are_shown_as_text(open_page: Any, strings_address: str) -> None:
    with open_page(strings_address) as watched:
        page = watched.open(strings_address)
        # The map shows its layers where there is no raster, too.
        page.wait_for_function(
            "() => performance.getEntriesByType('resource').some((one) => one.name.includes('layers/cracks'))"
        )
        page.locator('[aria-label="Rows of Poles"]').click()
        page.locator("td").nth(STRINGS - 1).wait_for()
        shown = page.evaluate("() => [...document.querySelectorAll('td')].map((one) => one.textContent)")
        assert shown == hostile_strings()
        assert (
            page.evaluate("document.querySelectorAll('td *, th img, th svg, iframe, img, script:not([src])').length")
            == 0
        )
        assert page.evaluate("window.hit") is None
