"""Draw docs/pictures/page.png: a car that is chosen in the page of `cflow view`.

    cflow view                       # writes the page
    python scripts/figures/page.py

Needs the extra `test`, and Chromium on the path.
"""

from __future__ import annotations

import io
import shutil
from pathlib import Path

from crossing import FLAGS
from PIL import Image
from playwright.sync_api import sync_playwright

FILE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "page.png"
PAGE = Path("outputs/view/synthetic-av2-0000.html")
OBJECT = "#sweep=5&object=15"


def main() -> None:
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        tab = browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme="dark")
        tab.goto(PAGE.resolve().as_uri() + OBJECT)
        tab.wait_for_function("window.viewer && viewer.ready", timeout=120_000)
        picture = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
        browser.close()
    picture.quantize(256, dither=Image.Dither.NONE).save(FILE, optimize=True)


if __name__ == "__main__":
    main()
