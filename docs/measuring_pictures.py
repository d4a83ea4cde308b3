"""Writes docs/pictures/viewer-control.jpg: control clicked in pictures, and a line measured in one.

python docs/measuring_pictures.py
"""

from __future__ import annotations

import io
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from playwright.sync_api import sync_playwright

from roadscan.simulate import simulate
from roadscan.site.doors import doors_of
from roadscan.site.live import LiveSite, open_survey
from roadscan.site.server import SiteServer
from tests.surveys import Simulated
from tests.viewer.conftest import CHROMIUM, FLAGS
from tests.viewer.test_measuring_in_pictures import (
    TOOLS,
    YARD,
    Yard,
    choose,
    click,
    in_picture,
    open_picture,
)

PICTURE: Final = Path(__file__).resolve().parent / "pictures/viewer-control.jpg"
LINE_PX: Final = ((236.0, 292.0), (250.0, 262.0), (262.0, 236.0))
"""Along the dashes in the first picture."""


def main() -> None:
    """Simulate a street with targets, run it, and use its page."""
    with tempfile.TemporaryDirectory() as folder:
        made = Simulated(simulate(YARD, Path(folder) / "survey").survey_file)
        made.run(products__make=["tile_table"], adjust__on=False)
        site = LiveSite(open_survey(made.survey_file, edited=True))
        with SiteServer(site, doors=doors_of(site, made.survey_file, edited=True)) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            with sync_playwright() as running:
                browser = running.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
                page = browser.new_page(viewport={"width": 1440, "height": 900})
                draw(page, Yard(made, server))
                picture = Image.open(io.BytesIO(page.screenshot()))
                browser.close()
            server.shutdown()
    picture.convert("RGB").save(PICTURE, quality=82, optimize=True)


def draw(page: Any, yard: Yard) -> None:
    """Measure a line in a picture, and a control point in three."""
    page.goto(f"{yard.server.address}&views=map,pictures")
    page.wait_for_selector('.picture-frame[data-state="shown"]')
    open_picture(page, "000000.jpg")
    page.locator(f'{TOOLS} [aria-label="Line on the ground"]').click()
    for pixel in LINE_PX:
        page.mouse.click(*in_picture(page, np.array(pixel)))
    page.mouse.dblclick(*in_picture(page, np.array(LINE_PX[-1])))
    page.locator(".figure").wait_for()
    page.locator(f'{TOOLS} [aria-label="Control points in pictures"]').click()
    page.wait_for_selector('.control-tiles[data-state="shown"]')
    choose(page, "P4")
    for number in range(3):
        click(yard, page, "P4", f"{number:06d}.jpg")
    page.locator(".control-tiles").evaluate("element => { element.scrollTop = 0 }")
    page.wait_for_timeout(1500)  # the map comes to rest


if __name__ == "__main__":
    main()
