"""Draw docs/pictures/crossing.webp, the animation of the README: a simulated crossing in the page of `cflow view`.

    python scripts/figures/crossing.py            # estimates the flow (minutes), then draws; the page is in outputs

Needs the extras `html` and `test`, and Chromium on the path. Five seconds of the drive are shown at half speed. Each
sweep is in two pictures, because the camera follows the vehicle smoothly.
"""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright
from tqdm import tqdm

from cflow_torch import make_config, make_model
from cflow_torch.applications.tracking import track
from cflow_torch.data.log import CachedLog, window
from cflow_torch.simulator import make_drive
from cflow_torch.viz import save_page

FILE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "crossing.webp"
SEED, FIRST, COUNT = 2, 2, 50
SIZE, MILLISECONDS, QUALITY = {"width": 720, "height": 405}, 100, 30
BACK, HEIGHT, AHEAD, SWING = 27.0, 17.0, 6.0, 12.0  # metres from the vehicle; degrees to either side
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader")
DRESS = """
for (const id of ["top", "time", "rose"]) document.getElementById(id).style.display = "none";
Object.assign(viewer.state, { follow: false, rings: false, labels: true, size: 1.5 });
"""


def main() -> None:
    page = Path("outputs/crossing.html")
    page.parent.mkdir(exist_ok=True)
    drive = make_drive(SEED, FIRST + COUNT + 2, "av2", "crossing")
    write_page(drive, page)
    T_viewer_ego = np.linalg.inv(drive.poses[FIRST + 1]) @ drive.poses[FIRST + 1 : FIRST + 2 + COUNT]
    pictures = take(page, T_viewer_ego[:, :3, 3])
    settings = {"duration": MILLISECONDS, "loop": 0, "quality": QUALITY, "method": 4}
    pictures[0].save(FILE, save_all=True, append_images=pictures[1:], **settings)
    print(f"{FILE}: {len(pictures)} pictures, {FILE.stat().st_size / 1e6:.2f} MB")


def write_page(drive, page: Path) -> None:
    model = make_model(make_config("default"))
    log = CachedLog(drive, FIRST + COUNT + 1)  # a sweep is simulated once
    pairs = tqdm(range(FIRST, FIRST + COUNT), unit="pair")
    results = [(i, model([window(log, i, model.config.num_history)])[0]) for i in pairs]
    table = track(log, results)
    save_page(log, results, page, tracks=lambda: table, preset="default")


def take(page: Path, vehicle: np.ndarray) -> list[Image.Image]:
    """Two pictures of each sweep, from behind the vehicle. Args: vehicle: (COUNT + 1, 3) its positions in the page."""
    pictures = []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        tab = browser.new_page(viewport=SIZE, color_scheme="dark")
        tab.goto(page.resolve().as_uri())
        tab.wait_for_function("window.viewer && viewer.ready", timeout=120_000)
        tab.evaluate(DRESS)
        for step in range(2 * COUNT):
            target = (vehicle[step // 2] + vehicle[(step + 1) // 2]) / 2 + [AHEAD, 0, 0]
            angle = np.radians(195 + SWING * np.sin(np.pi * step / COUNT))
            eye = target + [BACK * np.cos(angle), BACK * np.sin(angle), HEIGHT]
            tab.evaluate("camera => viewer.K3D.setCamera(camera)", [*eye.tolist(), *target.tolist(), 0, 0, 1])
            tab.evaluate("index => viewer.go(index)", step // 2)
            pictures.append(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
        browser.close()
    return pictures


if __name__ == "__main__":
    main()
