"""Chromium, and a page of a viewer in it."""

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-dev-shm-usage",
]  # fmt: skip
SIZE = {"width": 640, "height": 360}
SECONDS = 90  # that a busy machine is given; a quiet one needs one or two


@pytest.fixture(scope="session")
def browser():
    if not CHROMIUM.is_file():
        pytest.skip(f"no {CHROMIUM}: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), headless=True, args=FLAGS)
        yield browser
        browser.close()


class Tab:
    """A page in a profile of its own, and the session that serves it."""

    def __init__(self, browser, viewer):
        self.page = browser.new_page(viewport=SIZE, device_scale_factor=1)
        self.page.set_default_timeout(1000 * SECONDS)
        self.page.add_init_script("window.hurt = 0; window.xss = () => { window.hurt += 1 }")
        before = set(viewer.sessions)
        self.page.goto(viewer.url + "/?fixedDpr=1")
        # viser tells of software graphics some seconds late, over the scene, where it takes the clicks
        self.page.add_style_tag(content="[class*=Notification] { pointer-events: none !important }")
        self.until(lambda: set(viewer.sessions) - before)
        (mine,) = set(viewer.sessions) - before
        self.session = viewer.sessions[mine]
        self.settle()

    def until(self, met, seconds=SECONDS):
        """Wait with the browser's own loop running; `time.sleep` would stop it."""
        end = time.monotonic() + seconds
        while not met():
            assert time.monotonic() < end, "waited in vain"
            self.page.wait_for_timeout(30)

    def settle(self):
        """Wait until the viewer has done all that it was asked for."""
        self.until(self.session.idle)
        self.until(lambda: self.session.points.sent > 0)

    def mounted(self, name, there=True):
        """Wait until the scene in the browser has a node, or has it no more."""
        sign = "!=" if there else "=="
        self.page.wait_for_function(f"name => window.__viserMutable?.nodeRefFromName?.[name] {sign} null", arg=name)

    def ask(self, text):
        """Type a query and wait for its answer."""
        label = self.page.locator("label", has_text="Find")
        box = label.locator("xpath=ancestor::div[contains(@class,'Flex-root')][1]").locator("input")
        find = self.session.find
        before = (find.status.content, find.answer)
        self.page.wait_for_timeout(
            120
        )  # no faster than a person: of two messages within 50 ms the page sends the later
        box.fill(text)
        self.page.wait_for_timeout(120)
        box.press("Enter")
        self.until(lambda: find.status.content != before[0] or find.answer is not before[1])
        self.settle()

    def canvas(self):
        """Return where the picture of the scene is in the page: x, y, width, height."""
        box = self.page.locator("canvas").first.bounding_box()
        return float(box["x"]), float(box["y"]), int(box["width"]), int(box["height"])

    def pixel_of(self, item):
        """Return the place in the page of a pixel that shows an object, well inside it."""
        from scipy.ndimage import distance_transform_edt

        from openvocab_occ.export.render import render_map

        x, y, width, height = self.canvas()
        seen = render_map(self.session.content.scene, self.session.camera(width, height), 300.0)
        inner = distance_transform_edt(np.pad(seen.item == item.id, 1))[1:-1, 1:-1]
        v, u = np.unravel_index(int(np.argmax(inner)), inner.shape)
        assert inner[v, u] > 1, "the object is hidden"
        return x + float(u) + 0.5, y + float(v) + 0.5

    def click(self, place, key=None):
        """Click in the scene, with a key held if one is named."""
        self.page.mouse.move(*place)
        self.page.wait_for_timeout(150)
        if key:
            self.page.keyboard.down(key)
        self.page.mouse.click(*place)
        if key:
            self.page.keyboard.up(key)

    def photograph(self, width=320, height=180):
        """Return what the browser draws of the scene, RGB, without loss."""
        client, camera = self.session.client, self.session.client.camera
        pose = {"wxyz": camera.wxyz, "position": camera.position, "fov": camera.fov}
        with ThreadPoolExecutor(1) as pool:  # the browser answers only while its loop runs
            taken = pool.submit(client.get_render, height, width, transport_format="png", timeout=SECONDS, **pose)
            self.until(taken.done)
            return taken.result()[..., :3]


@pytest.fixture
def open_tab(browser):
    """Return a function that opens the page of a viewer; all pages are closed at the end."""
    tabs = []

    def open_one(viewer):
        tabs.append(Tab(browser, viewer))
        return tabs[-1]

    yield open_one
    for tab in tabs:
        tab.page.close()
