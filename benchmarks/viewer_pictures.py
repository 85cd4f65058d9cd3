"""Take the pictures of the viewer that README and docs show: `python benchmarks/viewer_pictures.py [NAME ...]`.

Needs Debian's Chromium and playwright. `city` maps the demo city (minutes), `keyframe` the nuScenes keyframe in
../shared/data with a road segmenter (no part of this project), `street` and `dark` the small street. Maps are kept in
out/pictures. Look at each picture before it is committed.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

import openvocab_occ as ovo
from openvocab_occ.segmentation.demo_models import demo_model, street_model

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "out" / "pictures"
DATA = ROOT / ".." / "shared" / "data"
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--use-gl=angle",
         "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]  # fmt: skip


def main(names: list[str]) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", headless=True, args=FLAGS)
        for name in names or list(SCENES):
            SCENES[name](browser)
        browser.close()


def city(browser: Any) -> None:
    """A town: a query by relevance, and an object in detail."""
    encoder, sequence = ovo.load_encoder(demo_model()), ovo.load_sequence("city", seed=7, frames=14, size=(704, 256))
    with ovo.view(mapped("city", sequence, encoder), encoder, sequence=sequence, port=0, block=False) as viewer:
        page, session = opened(browser, viewer)
        session.find.query.value = "parked trucks"
        session.find.ask("parked trucks")
        settle(page, session)
        best = session.find.answer.hits[0].object
        session.select(best.id)
        look(session, best.center, back=34.0, up=24.0)
        shoot(page, session, "viewer_city.png")
        page.get_by_role("tab", name="Time").click()
        session.layers.mode.value = "semantic"
        session.find.query.value = ""
        session.find.ask("")
        session.select(None)
        session.time.frame.value = 8
        session.time.kind.value = "image"
        ego = session.time.keyframe.T_world_ego
        settle(page, session)
        session.go(ego[:3, 3] - 16 * ego[:3, 0] + [0, 0, 11.0], ego[:3, 3] + 8 * ego[:3, 0])
        shoot(page, session, "viewer_time.png")


def keyframe(browser: Any) -> None:
    """One real keyframe, whose grid is carved from its LiDAR sweep."""
    name = "road-segmentation-adas-0001"
    encoder = ovo.load_encoder(DATA / "onnx" / "road_adas" / f"{name}.onnx", card(name))
    sequence = ovo.load_sequence("nuscenes-infos", DATA / "nuscenes_keyframe")
    with ovo.view(mapped("keyframe", sequence, encoder), encoder, sequence=sequence, port=0, block=False) as viewer:
        page, session = opened(browser, viewer)
        session.find.query.value = "road"
        session.find.ask("road")
        session.layers.mode.value = "relevance"
        page.get_by_role("tab", name="Time").click()
        session.time.kind.value = "depth"
        ego = session.content.scene.frames[0].T_world_ego
        settle(page, session)
        session.go(ego[:3, 3] - 20 * ego[:3, 0] + [0, 0, 26.0], ego[:3, 3] + 6 * ego[:3, 0])
        shoot(page, session, "viewer_keyframe.png", OUT)  # its data are for non-commercial use: not kept


def dark(browser: Any) -> None:
    """The small street in the dark: layers."""
    encoder, sequence = ovo.load_encoder(street_model()), ovo.load_sequence("street")
    with ovo.view(mapped("street", sequence, encoder), encoder, sequence=sequence, port=0, block=False) as viewer:
        page, session = opened(browser, viewer)
        session.layers.dark.value = True
        session.layers.mode.value = "instance"
        page.get_by_role("tab", name="Layers").click()
        for switch in session.layers.switches:
            switch.value = True
        settle(page, session)
        shoot(page, session, "viewer_layers.png")


SCENES: dict[str, Callable[[Any], None]] = {"city": city, "keyframe": keyframe, "dark": dark}


def mapped(name: str, sequence: Any, encoder: Any) -> ovo.SceneMap:
    """Return the map of a drive, built now or kept from before by the same model."""
    path = OUT / f"{name}-{encoder.fingerprint[:12]}.ovmap"
    if not path.is_dir():
        ovo.build_map(sequence, encoder, progress=lambda done, of: print(f"{name}: {done} of {of} frames")).save(path)
    return ovo.SceneMap.open(path)


def card(name: str) -> Path:
    return Path(ovo.__file__).parent / "segmentation" / "cards" / f"{name}.card.yaml"


def opened(browser: Any, viewer: Any) -> tuple[Any, Any]:
    page = browser.new_page(viewport={"width": 1280, "height": 720}, device_scale_factor=1)
    page.set_default_timeout(120_000)
    page.goto(viewer.url + "/?fixedDpr=1")
    until(page, lambda: viewer.sessions)
    session = next(iter(viewer.sessions.values()))
    settle(page, session)
    toast = page.locator(".mantine-Notification-closeButton")
    for _ in range(40):  # software graphics are told of, some seconds late
        if toast.count():
            toast.first.click()
            break
        page.wait_for_timeout(250)
    return page, session


def look(session: Any, target: np.ndarray, *, back: float, up: float) -> None:
    """Look at a place from behind the drive."""
    position, _ = session.content.viewpoint(session.content.scene.objects[session.selected])
    away = (position - target) * [1, 1, 0]
    away /= np.linalg.norm(away)
    session.go(target + back * away + [0, 0, up], target)


def until(page: Any, met: Callable[[], object], seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end, "waited in vain"
        page.wait_for_timeout(100)


def settle(page: Any, session: Any) -> None:
    """Wait until all is computed and drawn; labels and pictures load late."""
    page.wait_for_timeout(300)
    until(page, session.idle)
    page.wait_for_timeout(6000)


def shoot(page: Any, session: Any, name: str, folder: Path = ROOT / "docs" / "pictures") -> None:
    settle(page, session)
    page.screenshot(path=folder / name)
    print(folder / name)


if __name__ == "__main__":
    main(sys.argv[1:])
