"""The page in Chromium: what a person types, sees, and is safe from."""

import dataclasses
import threading
import time
from pathlib import Path

import pytest

from openvocab_occ.query.find import find
from openvocab_occ.viewer import panels, view

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-dev-shm-usage",
]  # fmt: skip
HOSTILE = "<img src onerror=xss()>"
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser():
    if not CHROMIUM.is_file():
        pytest.skip(f"no {CHROMIUM}: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), headless=True, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def viewer(street):
    with view(street, port=0, block=False) as viewer:
        yield viewer


def until(page, met, seconds=20):
    """Wait with the browser's own loop running; `time.sleep` would stop it."""
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, "waited in vain"
        page.wait_for_timeout(50)


def open_page(browser, viewer):
    """Return a new page in a profile of its own and the panel that serves it."""
    page = browser.new_page(viewport={"width": 640, "height": 360}, device_scale_factor=1)
    page.set_default_timeout(20_000)
    page.add_init_script("window.hurt = 0; window.xss = () => { window.hurt += 1 }")
    before = set(viewer.panels)
    page.goto(viewer.url + "/?fixedDpr=1")
    until(page, lambda: set(viewer.panels) - before)
    (mine,) = set(viewer.panels) - before
    return page, viewer.panels[mine]


def ask(page, panel, text):
    label = page.locator("label", has_text="Find")
    box = label.locator("xpath=ancestor::div[contains(@class,'Flex-root')][1]").locator("input")
    before = (panel.status.content, panel.answer)
    page.wait_for_timeout(120)  # no faster than a person: of two messages within 50 ms viser's page sends the later
    box.fill(text)
    page.wait_for_timeout(120)
    box.press("Enter")
    until(page, lambda: panel.status.content != before[0] or panel.answer is not before[1])


def test_a_typed_query_marks_the_right_objects(browser, viewer, street):
    page, panel = open_page(browser, viewer)
    try:
        page.wait_for_function("() => window.__viserMutable?.nodeRefFromName?.['/path'] != null")
        page.get_by_text("Synthetic input.").wait_for()
        ask(page, panel, "glimmering trucks")
        ids = [hit.object.id for hit in panel.answer.hits]
        assert ids == [item.id for item in street.objects if item.label == "truck"]
        page.get_by_text("2 objects").wait_for()
        page.get_by_text("not understood: glimmering").wait_for()
        for rank, id in enumerate(ids, start=1):
            cells = page.get_by_role("row", name=f"truck #{id}").get_by_role("cell").all_inner_texts()
            cells = [cell.replace("\xa0", " ") for cell in cells]
            assert cells[:3] == [str(rank), f"truck #{id}", "0.89"]
        page.wait_for_function("() => window.__viserMutable.nodeRefFromName['/hits/edges'] != null")
        page.get_by_role("button", name="2", exact=True).click()
        target = street.objects[ids[1]].center
        until(page, lambda: abs(panel.client.camera.look_at - target).max() < 0.1)
        ask(page, panel, "")
        assert panel.answer is None
        page.get_by_text("2 objects").wait_for(state="detached")
        page.wait_for_function("() => window.__viserMutable.nodeRefFromName['/hits/edges'] == null")
    finally:
        page.close()


def test_two_people_do_not_disturb_each_other(browser, viewer):
    first, first_panel = open_page(browser, viewer)
    second, second_panel = open_page(browser, viewer)
    try:
        ask(first, first_panel, "truck")
        assert second_panel.answer is None
        second.get_by_text("Type what you look for").wait_for()
        ask(second, second_panel, "tree")
        assert {hit.object.label for hit in first_panel.answer.hits} == {"truck"}
        assert {hit.object.label for hit in second_panel.answer.hits} == {"tree"}
        assert first.get_by_role("row", name="truck #").count() == 2
        assert first.get_by_role("row", name="tree #").count() == 0
        gone = second_panel.client.client_id
        second.close()
        until(first, lambda: gone not in viewer.panels)
        ask(first, first_panel, "car")
    finally:
        first.close()


def test_a_query_that_breaks_is_a_line_and_the_next_one_works(browser, viewer, monkeypatch):
    page, panel = open_page(browser, viewer)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(panels, "find", lambda *_: 1 / 0)
            ask(page, panel, "truck")
            page.get_by_text("ZeroDivisionError: division by zero").wait_for()
        ask(page, panel, "x" * 2000)
        page.get_by_text("query is too long").wait_for()
        ask(page, panel, "person")
        page.get_by_text("1 object,").or_(page.get_by_text("1 object", exact=True)).first.wait_for()
    finally:
        page.close()


def test_the_latest_query_wins(browser, viewer, monkeypatch):
    page, panel = open_page(browser, viewer)
    started, release = threading.Event(), threading.Event()

    def slow(scene, text, encoder):
        if text == "truck":
            started.set()
            release.wait(10)
        return find(scene, text, encoder)

    try:
        monkeypatch.setattr(panels, "find", slow)
        threads = [threading.Thread(target=panel.ask, args=(text,)) for text in ("truck", "car", "tree")]
        threads[0].start()
        assert started.wait(10)
        for later in threads[1:]:
            ticket = panel._ticket
            later.start()
            until(page, lambda ticket=ticket: panel._ticket > ticket)  # the order in which they ask
        shown = []
        monkeypatch.setattr(panel, "_show", lambda: shown.append(panel.answer.text))
        release.set()
        for thread in threads:
            thread.join()
        assert shown == ["tree"]
    finally:
        page.close()


def test_labels_and_queries_cannot_run_code(browser, street):
    labels = (*street.encoder.labels[:5], HOSTILE, street.encoder.labels[6])
    nodes = [dataclasses.replace(n, label=HOSTILE) if n.label == "truck" else n for n in street.objects.nodes]
    scene = dataclasses.replace(
        street,
        encoder=dataclasses.replace(street.encoder, labels=labels, name=HOSTILE),
        objects=type(street.objects)(nodes),
        provenance=dataclasses.replace(street.provenance, name=HOSTILE),
    )
    with view(scene, port=0, block=False) as viewer:
        page, panel = open_page(browser, viewer)
        try:
            ask(page, panel, "img src onerror xss")
            assert len(panel.answer.hits) == 2
            page.get_by_role("cell", name=HOSTILE).first.wait_for()
            panel.recolor("semantic")
            page.get_by_text(HOSTILE).nth(3).wait_for()
            ask(page, panel, "<script>xss()</script> <b onclick=xss()>")
            page.wait_for_timeout(300)
            assert page.evaluate("window.hurt") == 0
            assert page.locator("img[onerror], b[onclick]").count() == 0
            # the trap is armed: the same text unescaped does run
            panel.client.gui.add_html(HOSTILE)
            page.wait_for_function("() => window.hurt > 0")
        finally:
            page.close()
