"""Pages in a browser: the report can be turned, hovered over and scrubbed through, and complains of nothing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sigmaslam.report.report import write_report
from sigmaslam.run_record.dense_points import DENSE_NAME, write_dense_points
from tests.support.commands import run_here
from tests.support.recorded_runs import make_run

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright, of the extra dev")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip(f"needs one of {', '.join(BROWSERS)}")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=path, args=SOFTWARE_GL)
        yield started
        started.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("browser") / "run"
    make_run(folder, points=2000, pictures=True)
    return write_report(folder)


@pytest.fixture
def page(browser: Any, report: Path) -> Iterator[Any]:
    """The opened report, which must not have asked for anything nor complained."""
    opened = browser.new_page(viewport={"width": 1200, "height": 900}, offline=True)
    opened.set_default_timeout(60_000)
    complaints: list[str] = []
    requests: list[str] = []
    opened.on("console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else 0)
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("request", lambda request: requests.append(request.url))
    opened.goto(report.as_uri())
    opened.wait_for_function("window.report !== undefined")
    yield opened
    # Reading pixels back is slow, which browsers say.
    assert [each for each in complaints if "ReadPixels" not in each] == []
    assert [each for each in requests if not each.startswith(("data:", report.as_uri()))] == []
    opened.close()


def test_the_scene_shows_something_and_can_be_turned(page: Any):
    page.locator("#scene").scroll_into_view_if_needed()
    box = page.locator("#scene").bounding_box()
    before = page.evaluate("report.scene.camera.position.toArray()")
    picture = page.locator("#scene").screenshot()
    page.mouse.move(box["x"] + 400, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 520, box["y"] + 240, steps=3)
    page.mouse.up()
    after = page.evaluate("report.scene.camera.position.toArray()")
    assert max(abs(a - b) for a, b in zip(before, after, strict=True)) > 1.0
    page.wait_for_timeout(300)
    assert page.locator("#scene").screenshot() != picture


def test_surfaces_are_shown_in_their_grey_values_and_can_be_hidden(browser: Any, tmp_path: Path):
    make_run(tmp_path / "run", points=200)
    # A wall before all that the run has.
    x, y = np.meshgrid(np.linspace(-30.0, 30.0, 200), np.linspace(-30.0, 30.0, 200))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 5.0)], axis=-1)
    write_dense_points(tmp_path / "run" / DENSE_NAME, wall, np.full(len(wall), 0.1), np.full(len(wall), 190.0))
    opened = browser.new_page(viewport={"width": 1200, "height": 900}, offline=True)
    opened.set_default_timeout(60_000)
    complaints: list[str] = []
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.goto(write_report(tmp_path / "run").as_uri())
    opened.wait_for_function("window.report !== undefined")
    opened.locator("#scene").scroll_into_view_if_needed()

    def count_grey() -> float:
        opened.wait_for_timeout(300)
        picture = cv2.imdecode(np.frombuffer(opened.locator("#scene").screenshot(), np.uint8), cv2.IMREAD_COLOR)
        return float((np.abs(picture.astype(int) - picture[..., :1]).max(axis=2) < 3)[picture[..., 0] > 100].sum())

    shown = count_grey()
    opened.locator('[data-layer="dense"]').click()
    assert shown > 2.0 * count_grey()
    assert complaints == []
    opened.close()


def test_the_path_tells_its_sigma_under_the_mouse_and_shows_its_frame_on_a_click(page: Any):
    page.locator("#scene").scroll_into_view_if_needed()
    box = page.locator("#scene").bounding_box()
    # Where the pose of row 120 is on the screen.
    x, y = page.evaluate(
        """() => { const { scene, page } = report, p = scene.camera.position.clone();
        p.fromArray(page.scenes[0].path, 3 * 120).project(scene.camera);
        const box = document.getElementById("scene");
        return [(p.x + 1) / 2 * box.clientWidth, (1 - p.y) / 2 * box.clientHeight]; }"""
    )
    page.mouse.move(box["x"] + x, box["y"] + y)
    seconds = float(page.locator(".tip").text_content().split(" s,")[0])
    assert "sigma" in page.locator(".tip").text_content()
    page.mouse.click(box["x"] + x, box["y"] + y)
    shown = float(page.locator("#frame-text").text_content().split(" s,")[0])
    assert shown == pytest.approx(seconds, abs=0.5)


def test_frames_are_scrubbed_through(page: Any):
    slider = page.locator("#slider")
    texts = []
    for place in ("0", "7", slider.get_attribute("max")):
        slider.fill(place)
        texts.append(page.locator("#frame-text").text_content())
    seconds = [float(text.split(" s,")[0]) for text in texts]
    assert seconds == sorted(set(seconds))
    assert "matches used" in texts[1]


def test_the_worst_frames_begin_with_the_loss(page: Any):
    page.locator("#worst button").first.click()
    assert ", lost" in page.locator("#frame-text").text_content()
    assert page.locator("#worst button").count() == 10


def test_plots_tell_values_under_the_mouse(page: Any):
    plot = page.locator("#plot-0 .u-over")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 3, box["y"] + 50)
    row = page.evaluate("report.plots[0].cursor.idx")
    legend = page.locator("#plot-0 .u-legend .u-value").all_text_contents()
    drawn = page.evaluate("k => report.page.plots[0].series[0].values[k]", row)
    assert float(legend[1]) == pytest.approx(drawn, rel=1e-3)
    # The others follow.
    assert page.evaluate("report.plots[1].cursor.idx") == row


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_wider_than_a_phone(page: Any, scheme: str):
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": 400, "height": 800})
    page.wait_for_function("document.documentElement.scrollWidth <= 400", timeout=20_000)


def test_the_table_of_a_check_has_whole_words_on_a_phone(browser: Any, tmp_path: Path, demo_sequence: Path):
    done = run_here("check", demo_sequence, "--out", tmp_path / "check.html")
    assert done.returncode == 0, done.stderr
    opened = browser.new_page(viewport={"width": 400, "height": 800})
    opened.goto((tmp_path / "check.html").as_uri())
    lines = opened.evaluate(
        "[...document.querySelectorAll('td:first-child')].map(each => {"
        " const text = document.createRange(); text.selectNodeContents(each); return text.getClientRects().length; })"
    )
    assert len(lines) > 15
    assert max(lines) <= 2  # "principal point" may stand in two lines
    assert opened.evaluate("document.documentElement.scrollWidth") <= 400
    opened.close()


def test_a_browser_without_webgl_shows_the_rest(browser: Any, report: Path):
    opened = browser.new_page()
    opened.add_init_script(
        "HTMLCanvasElement.prototype.getContext = (get => function (kind, ...rest) {"
        " return kind.startsWith('webgl') ? null : get.call(this, kind, ...rest); })"
        "(HTMLCanvasElement.prototype.getContext)"
    )
    opened.goto(report.as_uri())
    opened.wait_for_function("window.report !== undefined")
    assert "no WebGL" in opened.locator("#scene").text_content()
    assert opened.evaluate("report.plots.length") == 7
    opened.close()


def test_one_time_line_moves_marker_picture_and_plots_and_plays(page: Any):
    slider, text = page.locator("#time"), page.locator("#time-text")
    slider.fill("30")
    seconds = page.evaluate("report.page.scenes[0].path_seconds[30]")
    assert text.text_content().startswith(f"{seconds:.2f} s")
    assert float(page.locator("#frame-text").text_content().split(" s,")[0]) == pytest.approx(seconds, abs=0.5)
    cursor = page.evaluate("report.plots[0].posToVal(report.plots[0].cursor.left, 'x')")
    assert cursor == pytest.approx(seconds, abs=0.2)
    page.locator("h1").click()
    page.keyboard.press("ArrowRight")
    assert slider.input_value() == "31"
    page.locator("#speed").select_option("4")
    page.locator("#follow").check()
    before = page.evaluate("report.scene.camera.position.toArray()")
    page.locator("#play").click()
    # Stopped in the same call: a slow machine would reach the end before another one, and play from the start.
    page.wait_for_function(
        "() => { const passed = +document.getElementById('time').value > 40;"
        " if (passed) document.getElementById('play').click(); return passed; }"
    )
    assert page.evaluate("report.scene.camera.position.toArray()") != before
    assert page.locator("#play").get_attribute("aria-pressed") == "false"
    stopped = slider.input_value()
    page.wait_for_timeout(300)
    assert slider.input_value() == stopped
