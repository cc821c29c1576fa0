"""Pages: their content is read back with plain loops, and a real browser opens, plays and recolours a page."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import zlib
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Iterator

import numpy as np
import pytest
import torch
from PIL import Image
from small_logs import make_small_drive
from toy_street import CAR, CAR_FLOW, FLOOR, STEP, WALL, Street, result_of

from cflow_torch import make_config, make_model
from cflow_torch.applications.tracking import track
from cflow_torch.data.log import window
from cflow_torch.viz import flow_to_rgb, save_page, show
from cflow_torch.viz.clusters import PALETTE

pytestmark = pytest.mark.skipif(find_spec("k3d") is None, reason="needs the extra html")
STATIC, GROUND, UNKNOWN, FIRST = range(4)


def content_of(html: str) -> dict[str, Any]:
    """The JSON of a page, whose frames get the texts of their points as `data`."""
    data = json.loads(script_of(html, "data"))
    for index, frame in enumerate(data["frames"]):
        assert "data" not in frame, "a browser cannot read one text of more than 512 MiB"
        frame["data"] = script_of(html, f"points-{index}")
    return data


def script_of(html: str, name: str) -> str:
    return re.search(rf'<script id="{name}"[^>]*>(.*?)</script>', html, re.DOTALL)[1]


def points_of(data: dict[str, Any], frame: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Positions (N, 3), metres, ego frame of t+1, and the entries of each colouring, decoded as the page does it."""
    chosen = data["frames"][frame]
    raw, n = zlib.decompress(base64.b64decode(chosen["data"])), chosen["count"]
    units, last = np.zeros((n, 3)), [0, 0, 0]
    for i in range(n):
        for axis in range(3):
            step = raw[2 * axis * n + i] | raw[(2 * axis + 1) * n + i] << 8
            last[axis] = (last[axis] + step + 2**15) % 2**16 - 2**15
        units[i] = last
    names = [coloring["name"] for coloring in data["colorings"]]
    entries = {name: np.frombuffer(raw, np.uint8, n, (6 + k) * n) for k, name in enumerate(names)}
    assert len(raw) == (6 + len(names)) * n
    return units * data["unit"], entries


def color_of(data: dict[str, Any], name: str, entry: int) -> np.ndarray:
    """(3,) colour of an entry."""
    (palette,) = (coloring["palette"] for coloring in data["colorings"] if coloring["name"] == name)
    return np.array(palette[entry - FIRST])


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("page") / "street.html"
    assert save_page(Street(), [(0, result_of()), (1, result_of(0.0))], path, voxel=1e-4) == 2
    return content_of(path.read_text(encoding="utf-8"))


def test_points_keep_their_positions_and_have_the_colours_of_their_flow(street: dict[str, Any]) -> None:
    given = Street().sweep(0).points[:50] - np.array([STEP, 0, 0], np.float32)  # without NaN
    position, entries = points_of(street, 0)
    distance = np.abs(given[:, None] - position[None]).max(axis=2)
    assert len(position) == 50 and (distance.min(axis=1) <= 0.005 + 1e-6).all(), "rounded to 1 cm"
    at = distance.argmin(axis=1)
    flow = entries["flow"][at]
    assert (flow[WALL] == STATIC).all() and (flow[FLOOR] == GROUND).all() and (flow[CAR] >= FIRST).all()
    wheel = flow_to_rgb(CAR_FLOW, 1.5).astype(int)
    assert np.abs(color_of(street, "flow", flow[0]) - wheel).max() < 40, "36 directions and 6 lengths"
    assert (entries["truth"][at][WALL] == UNKNOWN).all(), "the truth of the wall is unknown"
    np.testing.assert_array_equal(entries["truth"][at][CAR], flow[CAR])
    assert (entries["error"][at][CAR] == STATIC).all() and (entries["error"][at][FLOOR] == GROUND).all()
    car, wall = entries["object"][at][CAR], entries["object"][at][WALL]
    assert len(set(car)) == len(set(wall)) == 1
    assert FIRST <= car[0] < FIRST + len(PALETTE) <= wall[0], "the wall is pale"
    assert np.ptp(color_of(street, "object", car[0])) > 80 > 60 > np.ptp(color_of(street, "object", wall[0]))
    assert "confidence" not in entries
    still, entries = points_of(street, 1)
    assert (entries["flow"] < FIRST).all() and (entries["truth"] == np.where(entries["flow"], GROUND, UNKNOWN)).all()


def test_frames_have_poses_times_and_arrows(street: dict[str, Any]) -> None:
    first, second = street["frames"]
    np.testing.assert_allclose(np.reshape(second["pose"], (3, 4))[:, 3], [STEP, 0, 0], atol=1e-5)
    assert second["time"] - first["time"] == pytest.approx(0.1, abs=1e-4) and first["interval"] == 0.1
    (arrow,) = first["arrows"]
    assert arrow["cluster"] == 3 and arrow["speed"] == 6.7 and arrow["moving"] is None and not second["arrows"]
    np.testing.assert_allclose(arrow["ahead"], 5 * CAR_FLOW, atol=0.01)
    assert np.abs(color_of(street, "flow", arrow["entry"]) - flow_to_rgb(CAR_FLOW, 1.5)).max() < 40
    assert street["north"] == pytest.approx(np.pi / 2)


def test_the_colours_of_speed_error_and_directions() -> None:
    """Eight directions and a wrong flow: hue, ramp, and the level of flow that is too fast."""
    log = Street()
    for k in range(8):
        flow = np.array([np.cos(k * np.pi / 4 + 0.02), np.sin(k * np.pi / 4 + 0.02), 0]) * 1.49
        result = result_of()
        result.residual_flow[CAR] = torch.from_numpy(flow)
        data = content_of(show(window(log, 0), result, labels=log.labels(0)).html)
        entries = points_of(data, 0)[1]
        (entry,) = set(entries["flow"][entries["flow"] >= FIRST])
        assert np.abs(color_of(data, "flow", entry) - flow_to_rgb(flow, 1.5)).max() < 50, k
        error = np.linalg.norm(flow - CAR_FLOW)
        step = min(int(error / 0.35 * 64), 63)
        assert set(entries["error"]) <= {STATIC, GROUND, UNKNOWN, FIRST + step} and FIRST + step in entries["error"]
        assert set(entries["speed"]) == {STATIC, GROUND, FIRST + 63}
    result.residual_flow[CAR] = torch.from_numpy(flow * 2)
    data = content_of(show(window(log, 0), result).html)
    (entry,) = set(points_of(data, 0)[1]["flow"]) - {STATIC, GROUND}
    assert color_of(data, "flow", entry).max() < 220, "darker"


def test_only_static_points_are_thinned_and_the_page_says_so() -> None:
    log, result = Street(), result_of()
    data = content_of(show(window(log, 0), result, voxel=3.0).html)
    position, entries = points_of(data, 0)
    given = log.sweep(0).points[:50] - np.array([STEP, 0, 0], np.float32)
    voxels = {(*np.floor(point / 3), 0) for point in given[WALL]}
    voxels |= {(*np.floor(point / 6), 1) for point in given[FLOOR]}
    assert (entries["flow"] >= FIRST).sum() == 20 and len(position) == 20 + len(voxels) < 50
    assert f"{len(position)} of 50 points" in data["thinned"] and "3 m (6 m on the ground)" in data["thinned"]


def test_tracks_have_boxes_and_one_colour_in_all_sweeps() -> None:
    sweeps, results = [window(Street(), i) for i in range(2)], [result_of(), result_of()]
    columns = ("x", "y", "z", "length", "width", "height", "heading", "vx", "vy")
    table = {name: np.array([1.0, 2.0]) for name in columns}
    table.update(id=np.array([47, 47]), sweep=np.array([0, 1]), cluster_id=np.array([3, 3]))
    table.update({"num_points": np.array([20, 21]), "class": np.array(["car", "car"])})
    moving = torch.linspace(0, 1, len(results[1].residual_flow))
    results[1] = replace(results[1], moving=moving)
    data = content_of(show(sweeps, results, tracks=table).html)
    for frame in range(2):
        (box,) = data["frames"][frame]["boxes"]
        assert (
            box["id"] == 47
            and box["kind"] == "car"
            and box["size"] == [frame + 1.0] * 3
            and box["points"] == 20 + frame
        )
        assert box["speed"] == round(np.hypot(1, 1) * (frame + 1), 1)
        cars = moving[CAR].mean().item()
        assert box["moving"] == (None if frame == 0 else pytest.approx(cars, abs=0.006))
        entries = points_of(data, frame)[1]
        assert set(entries["object"][entries["flow"] >= FIRST]) == {FIRST + 47 % len(PALETTE)}


def test_a_name_in_the_data_cannot_run_as_a_script() -> None:
    html = show(window(Street(), 0), result_of(), title="</script><script>alert(1)</script>").html
    assert "alert(1)</script>" not in html and content_of(html)["title"].startswith("</script>")
    assert "[DATA]" not in html and "[K3D]" not in html
    html = show(window(Street(), 0), result_of(), title="[DATA] [K3D]").html
    assert content_of(html)["title"] == "[DATA] [K3D]" and "<title>[DATA] [K3D]</title>" in html


# ---- in a browser ------------------------------------------------------------------------------------------------

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = [  # software rendering, and no calls home
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]

SMALL = {"width": 720, "height": 480}  # pixels; the processor renders them


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield started
        started.close()


@pytest.fixture(scope="module")
def drive_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive: four sweeps, with labels and tracks."""
    drive, model = make_small_drive(num_sweeps=4), make_model(make_config(num_history=2))
    results = [(i, model([window(drive, i, model.config.num_history)])[0]) for i in range(3)]
    table, path = track(drive, results), tmp_path_factory.mktemp("drive") / "drive.html"
    save_page(drive, results, path, tracks=lambda: table, preset="default", voxel=0.4)
    assert path.stat().st_size < 3e6
    return path


LIST_FITS = """(() => {
  document.querySelector("#list td").textContent = "pedestrian #1160";  // the longest kind
  const panel = document.querySelector("#objects");
  return panel.scrollWidth <= panel.clientWidth;
})()"""


# Where the ids of tracks point to, away from the edges.
ANCHORS = """[...document.querySelectorAll("#labels span")]
  .filter(span => !span.hidden && span.textContent.includes("m/s"))
  .map(span => [parseFloat(span.style.left), parseFloat(span.style.top)])
  .filter(([x, y]) => x > 30 && x < innerWidth - 30 && y > 10 && y < innerHeight - 60)"""


# Number of lines that are drawn above the bottom of the world.
NUM_SEGMENTS = """(() => {
  const {vertices, indices} = viewer.K3D.getWorld().ObjectsListJson[2];
  return indices.data.filter(i => vertices.data[3 * i + 2] > -900).length;
})()"""


CAMERA = "viewer.K3D.getWorld().controls.getCameraArray()"


def picture(tab: Any) -> np.ndarray:
    """(H, W, 3) int64 screenshot."""
    return np.array(Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(np.int64)


def are_of(pixels: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels that have one of (C, 3) colours, within 2 levels."""
    keys, key_of_pixel = np.unique(pixels @ (1 << 16, 1 << 8, 1), return_inverse=True)
    shades = np.stack([keys >> 16, keys >> 8 & 255, keys & 255], axis=-1)
    is_one = (np.abs(shades[:, None] - colors).max(axis=2) <= 2).any(axis=1)
    return is_one[key_of_pixel.reshape(pixels.shape[:2])]


def count_of(pixels: np.ndarray, colors: np.ndarray) -> int:
    return int(are_of(pixels, colors).sum())


def test_a_browser_shows_plays_recolours_and_cleans_a_drive(browser: Any, drive_page: Path) -> None:
    context = browser.new_context(viewport=SMALL, color_scheme="dark")
    tab, requests, errors = context.new_page(), [], []
    tab.on("request", lambda request: requests.append(request.url))
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.goto(drive_page.as_uri())
    tab.wait_for_function("window.viewer && viewer.ready", timeout=60_000)
    assert tab.locator("h1").inner_text() and "preset default" in tab.locator("#head").inner_text()
    anchors = tab.evaluate(ANCHORS)
    for name in ("arrows", "boxes", "trails", "labels", "rings"):  # only points are left
        tab.locator(f"#show-{name}").uncheck()
    settled = "viewer.go(viewer.state.frame)"
    tab.evaluate(settled)
    assert tab.locator("#labels span").count() == 0
    assert tab.evaluate(NUM_SEGMENTS) == 0, "a path of one sweep is no line"

    data = content_of(drive_page.read_text(encoding="utf-8"))
    entries = points_of(data, 0)[1]
    colors = np.array([color_of(data, "flow", e) for e in np.unique(entries["flow"]) if e >= FIRST])
    tab.evaluate("document.querySelectorAll('.panel').forEach(panel => { panel.style.opacity = 0; })")  # not the legend
    first = picture(tab)
    assert count_of(first, colors) > 200, "moving objects are drawn in the colours of their flow"
    below = [first[int(y) - 5 : int(y) + 45, int(x) - 25 : int(x) + 25] for x, y in anchors]
    hits = [count_of(pixels, colors) > 0 for pixels in below]
    assert len(hits) > 2 and np.mean(hits) > 0.7, "points are where the tracks are"
    tab.locator("#show-ground").uncheck()
    tab.evaluate(settled)
    assert (picture(tab) != first).any(axis=2).sum() > 500, "the ground can be hidden"

    tab.locator("#coloring").select_option("object")
    tab.evaluate(settled)
    by_object = picture(tab)
    assert count_of(by_object, colors) < 20 and count_of(by_object, PALETTE.astype(int)) > 1000
    tab.locator("#slider").fill("2")
    tab.evaluate("viewer.go(viewer.state.frame)")
    assert tab.evaluate("viewer.state.frame") == 2 and "sweep 2 of 0 … 2" in tab.locator("#now").inner_text()
    assert (picture(tab) != by_object).any(axis=2).sum() > 500, "the next sweep differs"
    tab.locator("#play").click()
    tab.wait_for_function("viewer.state.frame !== 2", timeout=20_000)
    tab.locator("#play").click()

    tab.locator("#coloring").select_option("flow")
    tab.locator("#slider").fill("0")
    entries = [points_of(data, frame)[1]["flow"] for frame in range(3)]
    colors = np.array([color_of(data, "flow", e) for e in np.unique(np.concatenate(entries)) if e >= FIRST])

    def moving_pixels() -> np.ndarray:
        tab.evaluate(settled)
        return are_of(picture(tab), colors)

    of_sweep = moving_pixels()
    tab.locator("#map").select_option("all")
    assert (moving_pixels() & ~of_sweep).sum() > 500, "objects leave a trace in the map"
    tab.locator("#map").select_option("clean")
    assert moving_pixels().sum() < 0.02 * of_sweep.sum()
    tab.locator("#map").select_option("")
    tab.locator("#threshold").fill("0.95")
    assert moving_pixels().sum() < of_sweep.sum(), "what is unlikely to move is hidden"
    tab.locator("#theme").click()
    tab.evaluate(settled)
    assert picture(tab)[300, 2].min() > 200, "a light page"
    assert tab.evaluate("viewer.pause()") == pytest.approx(0.1)
    assert requests == [drive_page.as_uri()] and errors == []
    context.close()


def test_an_object_that_is_clicked_is_described_and_followed(browser: Any, drive_page: Path) -> None:
    context = browser.new_context(viewport={"width": 1000, "height": 700}, color_scheme="light")
    tab, errors = context.new_page(), []
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.goto(f"{drive_page.as_uri()}#sweep=1")
    tab.wait_for_function("window.viewer && viewer.ready", timeout=60_000)
    assert tab.evaluate("viewer.state.frame") == 1, "the sweep of the address"
    frames = content_of(drive_page.read_text(encoding="utf-8"))["frames"]
    boxes = frames[1]["boxes"]
    assert tab.locator("#list tbody tr").count() == len(boxes) and all(box["moving"] is not None for box in boxes)

    assert tab.evaluate(LIST_FITS), "no column is cut off"

    tab.keyboard.press("t")
    at = tab.evaluate("boxes => boxes.map(box => viewer.onScreen(box.centre))", boxes)
    middle = [np.hypot(x - 500, y - 350) for x, y, _ in at]
    clicked = boxes[int(np.argmin(middle))]
    x, y, _ = at[int(np.argmin(middle))]
    tab.mouse.click(x, y)
    tab.wait_for_function("viewer.state.chosen !== null")
    tab.evaluate("viewer.go(viewer.state.frame)")
    assert tab.evaluate("viewer.state.chosen") == clicked["id"]
    facts = tab.locator("#object").inner_text()
    assert f"#{clicked['id']}" in facts and f"{clicked['speed']:.1f} m/s" in facts
    assert " × ".join(f"{side:.1f}" for side in clicked["size"]) in facts and f"{clicked['moving']:.2f}" in facts
    assert tab.evaluate("location.hash") == f"#sweep=1&object={clicked['id']}"
    x, y, _ = tab.evaluate("centre => viewer.onScreen(centre)", clicked["centre"])
    assert np.hypot(x - 500, y - 350) < 5, "the camera looks at it"
    curve = tab.locator("#plot polyline").get_attribute("points").split()
    assert len(curve) == 3, "its speed in every sweep"
    tab.keyboard.press("ArrowRight")
    tab.wait_for_function("viewer.state.frame === 2")
    (after,) = (box for box in frames[2]["boxes"] if box["id"] == clicked["id"])
    x, y, _ = tab.evaluate("centre => viewer.onScreen(centre)", after["centre"])
    assert np.hypot(x - 500, y - 350) < 5, "the camera follows it"
    assert tab.locator("#plot text").first.text_content() == f"{max(1, after['speed'], clicked['speed']):.1f}"

    tab.keyboard.press("Escape")
    tab.wait_for_function("viewer.state.chosen === null")
    assert tab.locator("#object").is_hidden()
    row = tab.locator("#list tbody tr").nth(1)
    name, place = row.locator("td").first.inner_text(), row.bounding_box()
    tab.mouse.move(place["x"] + 9, place["y"] + place["height"] / 2)
    tab.mouse.down()
    tab.evaluate("viewer.go(0)")  # as a page that plays
    tab.mouse.up()
    tab.wait_for_function("viewer.state.chosen !== null")
    assert name.endswith(f"#{tab.evaluate('viewer.state.chosen')}") and errors == []
    tab.locator("#pursue").uncheck()
    before = tab.evaluate(CAMERA)
    tab.evaluate("viewer.go(1)")
    moved = np.subtract(tab.evaluate(CAMERA), before)[:3]
    first, second = (np.array(frame["pose"])[[3, 7, 11]] for frame in frames[:2])
    assert np.allclose(moved, second - first, atol=1e-3), "the camera follows the vehicle again"
    context.close()


# Number of labels that a panel or an edge of the screen covers in part.
NUM_CUT = """[...document.querySelectorAll("#labels span:not([hidden])")].map(e => e.getBoundingClientRect()).filter(
  a => a.left < 0 || a.right > innerWidth || a.top < 0 || a.bottom > innerHeight ||
  ["head", "objects", "side", "time", "rose"].map(id => document.getElementById(id).getBoundingClientRect()).some(
    b => a.right > b.left && a.left < b.right && a.bottom > b.top && a.top < b.bottom)).length"""


# What is drawn at the middle of the label of the chosen object.
COVER = """(() => {
  const {x, y, width, height} = document.querySelector("#labels .chosen:not([hidden])").getBoundingClientRect();
  return document.elementFromPoint(x + width / 2, y + height / 2).tagName;
})()"""


@pytest.mark.parametrize("size", [pytest.param((390, 760), marks=pytest.mark.slow), (360, 640)])
def test_a_phone_shows_all_controls_and_the_object_that_it_follows_beside_its_panel(
    browser: Any, drive_page: Path, size: tuple[int, int]
) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 700}, has_touch=True, color_scheme="light")
    tab = context.new_page()
    tab.goto(drive_page.as_uri())
    tab.wait_for_function("window.viewer && viewer.ready", timeout=60_000)
    boxes = [tab.locator(name).bounding_box() for name in ("#head", "#side", "#time", "#objects")]
    for box in boxes:
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["y"] + box["height"] <= 700
    head, side, time, objects = boxes
    assert head["y"] + head["height"] <= side["y"] and side["y"] + side["height"] <= time["y"], "nothing overlaps"
    assert head["y"] + head["height"] <= objects["y"] and objects["x"] + objects["width"] <= side["x"]
    tab.locator("#objects summary").click()
    tab.wait_for_function(f"{NUM_CUT} === 0")  # neither a panel nor an edge cuts off a label
    assert tab.locator("#list tbody tr").first.is_visible() and tab.evaluate(LIST_FITS), "no column is cut off"
    labels = tab.locator("#labels span:not(.ring)").all_inner_texts()
    assert labels and all(re.fullmatch(r"#\d+", text) for text in labels), "ids only"
    tab.set_viewport_size({"width": 360, "height": 700})
    assert tab.evaluate(LIST_FITS), "no column is cut off on a small phone"

    tab.locator("#list tbody tr").first.tap()
    tab.wait_for_function("viewer.state.chosen !== null")
    tab.set_viewport_size({"width": size[0], "height": size[1]})
    boxes = content_of(drive_page.read_text(encoding="utf-8"))["frames"][0]["boxes"]
    for box in boxes[:3]:
        tab.evaluate("id => viewer.choose(id)", box["id"])
        assert tab.evaluate(COVER) == "CANVAS", "no panel covers its label"
        panel, close = tab.locator("#objects").bounding_box(), tab.locator("#release").bounding_box()
        assert panel["y"] > size[1] / 2 and close["y"] + close["height"] <= panel["y"] + panel["height"]
    tab.locator("#release").tap()
    tab.wait_for_function("viewer.state.chosen === null")
    context.close()


@pytest.mark.slow
def test_every_key_and_control_does_what_it_says(browser: Any, drive_page: Path) -> None:
    context = browser.new_context(viewport={"width": 1000, "height": 700})
    tab = context.new_page()
    tab.goto(drive_page.as_uri())
    tab.wait_for_function("window.viewer && viewer.ready", timeout=60_000)

    def state(name: str) -> Any:
        tab.evaluate("viewer.go(viewer.state.frame)")  # what was asked for is done
        return tab.evaluate(f"viewer.state.{name}")

    def camera() -> np.ndarray:
        """(6,) position of the camera, and the point that it looks at, metres."""
        return np.array(tab.evaluate(CAMERA)[:6])

    start = camera()
    for key, name, value in [
        ("ArrowRight", "frame", 1),
        ("ArrowRight", "frame", 2),
        ("ArrowRight", "frame", 0),
        ("ArrowLeft", "frame", 2),
        ("ArrowLeft", "frame", 1),
        ("[", "pace", 0.5),
        ("]", "pace", 1),
        ("]", "pace", 2),
    ]:
        tab.keyboard.press(key)
        assert state(name) == value, key
    assert tab.locator("#pace").input_value() == "2"
    tab.locator("#pace").select_option("0.25")
    assert state("pace") == 0.25
    tab.locator("#pace").blur()
    tab.keyboard.press("Space")
    tab.wait_for_function("viewer.state.frame !== 1", timeout=20_000)
    assert state("timer") and tab.locator("#play").inner_text() != "▶"
    tab.keyboard.press("Space")
    assert state("timer") is None and tab.locator("#play").inner_text() == "▶"

    tab.locator("#slider").fill("0")
    assert state("frame") == 0 and np.allclose(camera(), start, atol=1e-3), "the camera goes with the vehicle"
    for above, reset in (("t", "r"), ("#above", "#reset")):
        press = tab.keyboard.press if above == "t" else lambda name: tab.locator(name).click()
        press(above)
        assert np.linalg.norm((camera()[:3] - camera()[3:])[:2]) < 0.1, "straight from above"
        press(reset)
        assert state("frame") == 0 and np.allclose(camera(), start, atol=1e-3)
    tab.locator("#show-follow").uncheck()
    tab.locator("#slider").fill("1")
    assert state("frame") == 1 and np.allclose(camera(), start, atol=1e-3), "the camera stays"

    rows = tab.locator("#list tbody tr")
    rows.nth(1).click()
    chosen = state("chosen")
    assert rows.nth(1).inner_text().split("\t")[0].endswith(f"#{chosen}") and "chosen" in rows.nth(1).get_attribute(
        "class"
    )
    tab.locator("#pursue").uncheck()
    before = camera()
    plot = tab.locator("#plot").bounding_box()
    tab.mouse.click(plot["x"] + plot["width"] - 8, plot["y"] + 20)
    assert state("frame") == 2 and np.allclose(camera(), before), "the plot chooses a sweep; the camera stays"
    tab.locator("#pursue").check()
    assert not np.allclose(camera(), before)
    tab.locator("#release").click()
    assert state("chosen") is None and tab.locator("#object").is_hidden()
    tab.evaluate(f"location.hash = '#sweep=1&object={chosen}'")
    tab.wait_for_function(f"viewer.state.chosen === {chosen}")
    assert state("frame") == 1
    tab.keyboard.press("r")
    assert state("chosen") is None and tab.evaluate("location.hash") == "#sweep=1"

    count = rows.count()
    tab.locator("#threshold").fill("0.95")
    assert state("threshold") == 0.95 and tab.locator("#likely span").inner_text() == "0.95" and rows.count() < count
    tab.locator("#size").fill("3")
    assert state("size") == 3
    context.close()


def test_a_notebook_shows_the_page_inline(browser: Any, tmp_path: Path) -> None:
    tab = browser.new_page(viewport=SMALL)
    (tmp_path / "cell.html").write_text(show(window(Street(), 0), result_of())._repr_html_(), encoding="utf-8")
    tab.goto((tmp_path / "cell.html").as_uri())
    tab.frame_locator("iframe").locator("#now:has-text('sweep 0 of 0')").wait_for(timeout=60_000)
    tab.close()


@pytest.fixture(scope="module")
def every_fifth(browser: Any, drive_page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, int]]:
    """A page of every fifth pair, whose address names an object that its first sweep lacks, and that object's id."""
    text = drive_page.read_text(encoding="utf-8")
    script = script_of(text, "data")
    data = json.loads(script)
    for frame in data["frames"]:
        frame["sweep"] *= 5
    ids = [{box["id"] for box in frame["boxes"]} for frame in data["frames"]]
    late = min(ids[0] & ids[1])
    data["frames"][0]["boxes"] = [box for box in data["frames"][0]["boxes"] if box["id"] != late]
    path = tmp_path_factory.mktemp("fifth") / "page.html"
    path.write_text(text.replace(script, json.dumps(data)), encoding="utf-8")
    tab = browser.new_page(viewport=SMALL)
    tab.goto(f"{path.as_uri()}#sweep=0&object={late}")
    tab.wait_for_function("window.viewer && viewer.ready", timeout=60_000)
    yield tab, late
    tab.close()


def test_a_page_of_every_fifth_pair_has_the_pace_of_the_drive_and_the_sweep_of_its_address(
    every_fifth: tuple[Any, int], drive_page: Path
) -> None:
    tab, late = every_fifth
    assert tab.evaluate("viewer.pause()") == pytest.approx(0.5)
    assert tab.evaluate("[viewer.state.frame, viewer.state.chosen]") == [0, late]
    assert "not seen in this sweep" in tab.locator("#object").inner_text()
    tab.evaluate("viewer.go(1)")
    frames = content_of(drive_page.read_text(encoding="utf-8"))["frames"]
    (box,) = (box for box in frames[1]["boxes"] if box["id"] == late)
    np.testing.assert_allclose(tab.evaluate(CAMERA)[3:6], box["centre"], atol=0.01, err_msg="the camera finds it")
    tab.evaluate("viewer.go(0)")
    tab.evaluate(f"location.hash = '#object={late}'")
    tab.wait_for_function("viewer.state.frame === 1")
    tab.evaluate("location.hash = '#sweep=99'")
    tab.wait_for_function("location.hash === '#sweep=5'")  # there is no sweep 99
    tab.evaluate("viewer.go(99)")
    assert "needs a current browser" in tab.locator("#head p").inner_text()
    tab.evaluate("viewer.go(2)")
    assert tab.evaluate("viewer.state.frame") == 2, "after an error, the controls work"


def test_keys_stay_with_the_control_that_has_the_focus(every_fifth: tuple[Any, int]) -> None:
    tab, _ = every_fifth
    for name, value in (("#show-rings", "rings"), ("#show-labels", "labels")):
        before = tab.evaluate(f"viewer.state.{value}")
        tab.locator(name).focus()
        tab.keyboard.press("Space")
        assert tab.evaluate(f"viewer.state.{value}") is not before and tab.evaluate("viewer.state.timer") is None
    tab.locator("#slider").click()
    assert tab.evaluate("document.activeElement.id") == "slider"
    for key, expression in (("]", "viewer.state.pace === 2"), ("Space", "viewer.state.timer !== null")):
        tab.keyboard.press(key)
        assert tab.evaluate(expression), "a slider has no use for this key"
    tab.keyboard.press("Space")
    start = tab.evaluate(CAMERA)
    tab.locator("#coloring").focus()
    tab.keyboard.press("t")
    assert np.allclose(tab.evaluate(CAMERA), start), "the list searches for a name with t"
    tab.locator("#above").focus()
    tab.keyboard.press("Space")
    assert tab.evaluate("viewer.state.timer") is None and not np.allclose(tab.evaluate(CAMERA), start)


def test_a_browser_that_is_too_old_says_so(browser: Any, drive_page: Path) -> None:
    tab = browser.new_page()
    tab.add_init_script("delete window.DecompressionStream")
    tab.goto(drive_page.as_uri())
    tab.locator("#head p:has-text('DecompressionStream is not defined: this page needs a current browser')").wait_for()
    assert tab.locator("h1").inner_text() == make_small_drive(num_sweeps=4).log_id
    tab.close()
