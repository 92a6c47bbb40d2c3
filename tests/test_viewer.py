"""The player in a real browser: it plays, scrubs, orbits and stays off the network; and what the writer refuses."""

import base64
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from selenium.webdriver import ActionChains, Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.wait import WebDriverWait

from jaxmocap import Motion
from jaxmocap.viewer import Track, motion_player, player_html

FRAMES, FRAME_TIME = 240, 1 / 60
PARENTS = (-1, 0, 1, 2, 2, 4, 5, 2, 7, 8, 0, 10, 11, 0, 13)
NAMES = ("hips", "spine", "chest", "head", "l_shoulder", "l_elbow", "l_hand", "r_shoulder", "r_elbow", "r_hand",
         "l_hip", "l_knee", "l_foot", "r_hip", "r_knee")  # fmt: skip
REST = [(0, 95, 0), (0, 20, 0), (0, 25, 0), (0, 25, 0), (18, 5, 0), (4, -28, 0), (0, -25, 0), (-18, 5, 0), (-4, -28, 0),
        (0, -25, 0), (10, -5, 0), (0, -42, 0), (0, -42, 0), (-10, -5, 0), (0, -42, 0)]  # fmt: skip


def figure(title: str, sway: float = 1.0) -> Track:
    """A figure that walks along z and swings its limbs, in cm."""
    time = np.arange(FRAMES) * FRAME_TIME
    positions = np.zeros((FRAMES, len(NAMES), 3))
    for j, parent in enumerate(PARENTS):
        positions[:, j] = REST[j] if parent < 0 else positions[:, parent] + REST[j]
        positions[:, j, 2] += sway * 8 * np.sin(5 * time + j) + (100 * time if parent < 0 else 0)
    return Track(title, positions, PARENTS, NAMES)


ORIGINAL, DECODED = figure("original"), figure("decoded", 1.1)


# ---- The writer


def payload(page: str) -> dict:
    """The data in a page, as the browser's parser would find it: up to the first closing tag."""
    found = re.search(r'<script id="data" type="application/json">(.*?)</script', page, re.S)
    assert found
    return json.loads(found[1])


def test_positions_survive_to_less_than_a_pixel():
    data = payload(player_html([ORIGINAL, DECODED], FRAME_TIME))
    path = np.frombuffer(base64.b64decode(data["path"]), "<f4").reshape(FRAMES, 1, 3)
    for track, text in zip((ORIGINAL, DECODED), data["positions"], strict=True):
        steps = np.frombuffer(base64.b64decode(text), "<i2").reshape(track.positions.shape)
        assert np.abs(path + data["step"] * steps - track.positions).max() < 0.01


def test_errors_are_those_of_the_exact_positions():
    shift = 1e-5 * np.arange(len(NAMES))[:, None] * np.array([0.0, 0.6, 0.8])
    data = payload(player_html([ORIGINAL, ORIGINAL._replace(positions=ORIGINAL.positions + shift)], FRAME_TIME))
    per_joint = np.frombuffer(base64.b64decode(data["errors"]["joints"]), "<f4").reshape(FRAMES, -1)
    np.testing.assert_allclose(per_joint, np.tile(1e-5 * np.arange(len(NAMES)), (FRAMES, 1)), atol=1e-12)
    np.testing.assert_allclose(np.frombuffer(base64.b64decode(data["errors"]["mean"]), "<f4"), 7e-5, rtol=1e-6)
    assert data["errors"]["maxOverall"] == pytest.approx(14e-5)


def test_titles_cannot_break_out_of_the_page():
    title = "</script><script>alert(1)</script>{{data}}\u2028\"'&"
    page = player_html([ORIGINAL._replace(title=title)], FRAME_TIME, subtitle=title)
    assert payload(page)["titles"] == [title] and payload(page)["subtitle"] == title
    assert page.count("<script") == 2 and page.count("</script") == 2


def test_the_page_refers_to_nothing_outside():
    template = resources.files("jaxmocap.viewer").joinpath("player.html").read_text("utf-8")
    assert not re.search(r"http|//\w|url\(|@import|src=|fetch|XMLHttp|WebSocket", template)


@pytest.mark.parametrize(
    ("tracks", "message"),
    [
        ([], "0 tracks"),
        ([ORIGINAL] * 3, "3 tracks"),
        ([ORIGINAL, DECODED._replace(positions=DECODED.positions[1:])], "same frames and joints"),
        ([ORIGINAL._replace(positions=ORIGINAL.positions[:, :3])], "15 parents and 15 names for 3 joints"),
        ([ORIGINAL._replace(positions=ORIGINAL.positions[:0])], "none of them 0"),
        ([ORIGINAL._replace(positions=np.full_like(ORIGINAL.positions, np.nan))], "NaN"),
        ([ORIGINAL._replace(parents=PARENTS[::-1])], "precede"),
    ],
)
def test_refuses_what_it_cannot_draw(tracks: list[Track], message: str):
    with pytest.raises(ValueError, match=message):
        player_html(tracks, FRAME_TIME)


@pytest.mark.parametrize("frame_time", [0.0, -1.0, float("nan"), float("inf")])
def test_refuses_a_frame_time_that_is_none(frame_time: float):
    with pytest.raises(ValueError, match="frame_time"):
        player_html([ORIGINAL], frame_time)


def test_motions_go_through_forward_kinematics():
    a = Motion.from_positions(ORIGINAL.positions / 2.54, NAMES, FRAME_TIME, PARENTS, unit_cm=2.54)
    b = Motion.from_positions(DECODED.positions / 2.54, NAMES, FRAME_TIME, PARENTS, unit_cm=2.54)
    data = payload(motion_player(a, b, ("walk", "walk'")))
    wanted = np.linalg.norm(ORIGINAL.positions - DECODED.positions, axis=-1).mean()
    assert data["errors"]["meanOverall"] == pytest.approx(wanted, rel=1e-4)
    assert (data["titles"], data["unit"], data["parents"]) == (["walk", "walk'"], "cm", list(PARENTS))
    alone = payload(motion_player(Motion(a.skeleton, a.values, FRAME_TIME)))
    assert (alone["titles"], alone["unit"], alone["errors"]) == (["original"], "units", None)


# ---- The page


class Browser:
    """Chromium with one page open; `until` waits for what a slow machine takes long to do."""

    def __init__(self, driver: Chrome, folder: Path):
        self.driver, self.folder = driver, folder

    def open(self, page: str, reduced_motion: bool = True) -> None:
        preference = {"name": "prefers-reduced-motion", "value": "reduce" if reduced_motion else "no-preference"}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [preference]})
        file = self.folder / "player.html"
        file.write_text(page, "utf-8")
        self.driver.get(file.as_uri())
        self.until(lambda: self.js("return player.ready"))

    def js(self, script: str):
        return self.driver.execute_script(script)

    def until(self, condition: Callable[[], object], seconds: float = 20) -> None:
        WebDriverWait(self.driver, seconds, 0.05).until(lambda _: condition())

    def find(self, name: str) -> WebElement:
        return self.driver.find_element(By.ID, name)

    def text(self, name: str) -> str:
        return self.find(name).text

    def seek(self, frame: int) -> None:
        self.js(f"player.seek({frame})")
        self.settle()

    def settle(self) -> None:
        """Returns when the page has drawn what it was told to: its own drawing comes first in the next two frames."""
        self.driver.execute_async_script(
            "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(done))"
        )

    def pixels(self, view: int) -> np.ndarray:
        """What the canvas shows in view `view`, as RGBA bytes."""
        text = self.js(f"""
            const v = player.views[{view}], c = document.getElementById("view"), k = c.width / c.clientWidth;
            const copy = new OffscreenCanvas(v.w * k - 4, v.h * k).getContext("2d", {{willReadFrequently: true}});
            copy.drawImage(c, -v.x * k - 2, -v.y * k);
            const image = copy.getImageData(0, 0, copy.canvas.width, copy.canvas.height);
            let text = ""; for (const byte of image.data) text += String.fromCharCode(byte);
            return btoa(text);""")
        return np.frombuffer(base64.b64decode(text), np.uint8).reshape(-1, 4)

    def drag(self, dx: int, dy: int) -> None:
        ActionChains(self.driver).move_to_element(self.find("view")).click_and_hold().move_by_offset(
            dx, dy
        ).release().perform()
        self.settle()

    def type(self, *keys: str) -> None:
        ActionChains(self.driver).send_keys(*keys).perform()
        self.settle()


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    chromium, chromedriver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and chromedriver):
        reason = "no chromium and chromedriver on PATH: the player is not tested in a browser"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    options = ChromeOptions()
    options.binary_location = chromium
    for flag in ("headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-sync",
                 "disable-background-networking", "disable-component-update", "window-size=1000,700",
                 f"user-data-dir={tmp_path_factory.mktemp('chromium')}"):  # fmt: skip
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = Chrome(options, Service(chromedriver))
    driver.set_script_timeout(20)
    try:
        yield driver
    finally:
        driver.quit()


@pytest.fixture
def browser(driver: Chrome, tmp_path: Path) -> Iterator[Browser]:
    """A browser; afterwards nothing but the page itself was asked for, and the console is empty."""
    for log in ("browser", "performance"):
        driver.get_log(log)
    yield Browser(driver, tmp_path)
    assert driver.get_log("browser") == []
    events = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    outside = [url for url in asked if not url.startswith(("file:", "data:", "chrome:"))]  # chrome: its own first tab
    assert asked and outside == []


@pytest.fixture
def pair(browser: Browser) -> Browser:
    browser.open(player_html([ORIGINAL, DECODED], FRAME_TIME, subtitle="a walk"))
    return browser


def test_it_plays_by_itself_in_real_time(browser: Browser):
    browser.open(player_html([ORIGINAL, DECODED], FRAME_TIME), reduced_motion=False)
    browser.until(lambda: browser.js("return player.playing && player.frame > 0"))
    for speed in (0.5, 2):
        # The page's own clock times it, at the moment of drawing, so that a slow test machine does not matter.
        seconds, advanced = browser.driver.execute_async_script(f"""
            const done = arguments[0]; player.setSpeed({speed}); player.seek(0);
            requestAnimationFrame(start => {{
                const first = player.frame;
                const watch = now => now - start > 1000 ? done([(now - start) / 1000, player.frame - first])
                                                        : requestAnimationFrame(watch);
                requestAnimationFrame(watch);
            }});""")
        assert advanced * FRAME_TIME == pytest.approx(seconds * speed, abs=0.15 * speed)
    browser.js("player.seek(player.frames - 2)")
    browser.until(lambda: browser.js("return player.playing && player.frame < player.frames / 2"))  # it loops


def test_it_waits_where_motion_is_unwelcome(pair: Browser):
    pair.settle()
    assert pair.js("return [player.playing, player.frame]") == [False, 0]
    pair.find("play").click()
    pair.until(lambda: pair.js("return player.playing && player.frame > 2"))
    assert pair.find("play").get_attribute("aria-label") == "Pause"
    pair.find("play").click()
    stopped = pair.js("return player.frame")
    pair.settle()
    assert pair.js("return [player.playing, player.frame]") == [False, stopped]


def test_without_loop_it_stops_at_the_end(pair: Browser):
    pair.find("loop").click()
    pair.seek(FRAMES - 10)
    pair.js("player.play()")
    pair.until(lambda: not pair.js("return player.playing"))
    assert pair.js("return player.frame") == FRAMES - 1
    pair.js("player.play()")
    pair.until(lambda: 0 < pair.js("return player.frame") < FRAMES - 10)


@pytest.mark.parametrize("name", ["curve", "scrub"])
def test_the_timeline_seeks_by_click_and_drag(pair: Browser, name: str):
    line = pair.find(name)
    quarter = line.size["width"] // 4
    mouse = ActionChains(pair.driver).move_to_element(line).click()
    mouse.perform()
    assert pair.js("return player.frame") == pytest.approx(FRAMES / 2, abs=2)
    mouse = ActionChains(pair.driver).move_to_element(line).click_and_hold()
    mouse.move_by_offset(quarter, 0).release().perform()
    assert pair.js("return player.frame") == pytest.approx(0.75 * FRAMES, abs=6)
    pair.settle()
    assert pair.text("frame").startswith(str(pair.js("return player.frame")) + " /")


def test_both_figures_move(pair: Browser):
    pair.find("follow").click()  # the ground stands still, so what changes is the figure
    pair.find("top").clear()
    pair.find("top").send_keys("1000000")  # and no longer its colour
    shown = {}
    for frame in (0, 20):
        pair.seek(frame)
        shown[frame] = [pair.pixels(view) for view in (0, 1)]
    for before, after in zip(shown[0], shown[20], strict=True):
        assert 0.002 < (before != after).any(-1).mean() < 0.3
    pair.seek(0)
    assert all((pair.pixels(view) == shown[0][view]).all() for view in (0, 1))


def test_a_drag_orbits_both_views_and_reset_restores(pair: Browser):
    before = [pair.pixels(view) for view in (0, 1)]
    placed = np.array(pair.js("return player.jointsOnScreen(0, 0)"))
    for by in ((0, 30), (140, 0)):
        shown = [pair.pixels(view) for view in (0, 1)]
        pair.drag(*by)
        for view in (0, 1):
            assert (pair.pixels(view) != shown[view]).any(-1).mean() > 0.02
    turned = np.array(pair.js("return player.jointsOnScreen(0, 0)"))
    assert np.abs(turned - placed).max() > 5
    other = np.array(pair.js("return player.jointsOnScreen(1, 0)")) - [pair.js("return player.views[1].x"), 0]
    np.testing.assert_allclose(other, turned, atol=1e-6)  # the cameras are linked
    pair.find("reset").click()
    pair.settle()
    assert all((pair.pixels(view) == before[view]).all() for view in (0, 1))


def test_the_wheel_zooms_and_shift_drag_pans(pair: Browser):
    def joints() -> np.ndarray:
        return np.array(pair.js("return player.jointsOnScreen(0, 0)"))

    before = joints()
    ActionChains(pair.driver).scroll_from_origin(
        ScrollOrigin.from_element(pair.find("view")), 0, -300
    ).perform()
    pair.until(lambda: np.ptp(joints(), 0).max() > 1.2 * np.ptp(before, 0).max())
    pair.js("player.zoom(0.2)")
    still = joints()
    ActionChains(pair.driver).key_down(Keys.SHIFT).perform()
    pair.drag(50, 20)
    ActionChains(pair.driver).key_up(Keys.SHIFT).perform()
    np.testing.assert_allclose((joints() - still).mean(0), [50, 20], atol=3)


def test_overlay_puts_both_figures_in_one_view(pair: Browser):
    pair.find("overlay").click()
    assert pair.js("return [player.mode, player.views.length, player.views[0].tracks]") == ["overlay", 1, [0, 1]]
    a, b = (np.array(pair.js(f"return player.jointsOnScreen(0, {track})")) for track in (0, 1))
    assert 0 < np.abs(a - b).max() < 30
    pair.find("overlay").click()
    assert pair.js("return [player.mode, player.views.length]") == ["side", 2]


def test_the_keyboard_does_it_all(pair: Browser):
    def frame() -> int:
        return pair.js("return player.frame")

    pair.type(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    assert frame() == 1
    ActionChains(pair.driver).key_down(Keys.SHIFT).send_keys(Keys.ARROW_RIGHT).key_up(Keys.SHIFT).perform()
    assert frame() == 11
    pair.type(Keys.END)
    assert frame() == FRAMES - 1
    pair.type(Keys.HOME, "o", "]")
    assert pair.js("return [player.frame, player.mode, player.speed]") == [0, "overlay", 2]
    before = pair.pixels(0)
    pair.type("a", "+")
    assert (pair.pixels(0) != before).any()
    pair.type(" ")
    pair.until(lambda: pair.js("return player.playing") and frame() > 0)
    pair.type(" ")
    assert not pair.js("return player.playing")
    reached = []
    for _ in range(20):
        pair.type(Keys.TAB)
        reached.append(pair.js("return document.activeElement.id"))
    wanted = {"view", "top", "auto", "play", "back", "next", "speed", "loop", "overlay", "follow", "reset", "scrub"}
    assert wanted <= set(reached)


def test_the_readout_tells_the_error_of_the_frame(pair: Browser):
    error = np.linalg.norm(ORIGINAL.positions - DECODED.positions, axis=-1)
    frame = 100
    pair.seek(frame)
    assert pair.text("frame") == f"{frame} / {FRAMES - 1}"
    assert pair.text("time") == f"{frame * FRAME_TIME:.3f} s"
    assert pair.text("mean") == f"{error[frame].mean():.2f} cm"
    assert pair.text("max") == f"{error[frame].max():.2f} cm"
    assert pair.text("worst") == NAMES[error[frame].argmax()]
    assert NAMES[error[frame].argmax()] in (pair.find("scrub").get_attribute("aria-valuetext") or "")


def test_hovering_names_the_joint_and_its_error(pair: Browser):
    pair.seek(60)
    joint, view = NAMES.index("head"), pair.find("view")
    x, y = pair.js(f"return player.jointsOnScreen(1, 1)[{joint}]")
    offset = round(x - view.size["width"] / 2), round(y - view.size["height"] / 2)
    ActionChains(pair.driver).move_to_element_with_offset(view, *offset).perform()
    error = np.linalg.norm(ORIGINAL.positions - DECODED.positions, axis=-1)[60, joint]
    assert pair.text("tip").split() == ["head", f"{error:.2f}", "cm"]


def test_the_colour_scale_can_be_set(pair: Browser):
    before = pair.pixels(1)
    pair.find("top").clear()
    pair.find("top").send_keys("0.2")
    pair.settle()
    assert (pair.pixels(1) != before).any()
    assert pair.find("auto").get_attribute("aria-pressed") == "false"
    pair.find("auto").click()
    pair.settle()
    assert (pair.pixels(1) == before).all()


@pytest.mark.parametrize(
    "track",
    [
        pytest.param(ORIGINAL._replace(parents=(-1,) * len(NAMES)), id="dots"),
        pytest.param(ORIGINAL._replace(positions=ORIGINAL.positions[:1]), id="one frame"),
        pytest.param(Track("</script>point", np.zeros((3, 1, 3)), (-1,), ("p",)), id="one still joint"),
    ],
)
def test_one_track_shows_no_error(browser: Browser, track: Track):
    browser.open(player_html([track], FRAME_TIME), reduced_motion=False)
    browser.settle()
    assert browser.text("heading") == track.title
    assert not any(browser.find(name).is_displayed() for name in ("legend", "curve", "overlay", "mean", "worst"))
    assert browser.find("play").is_enabled() == (len(track.positions) > 1)
    assert np.isfinite(browser.js("return player.jointsOnScreen(0, 0)")).all()
    assert len(np.unique(browser.pixels(0), axis=0)) > 20


def test_a_phone_has_every_control_in_sight(browser: Browser):
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        browser.open(player_html([ORIGINAL, DECODED], FRAME_TIME))
        assert browser.js("return document.documentElement.scrollWidth") == 390
        outside = browser.js("""return [...document.querySelectorAll("button, select, input, canvas")].filter(e => {
            const b = e.getBoundingClientRect();
            return b.left < 0 || b.right > 390 || b.bottom > 844; }).map(e => e.id)""")
        assert outside == []
        assert browser.js("return document.getElementById('view').width") == 780
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
