"""`openvocab-occ city`."""

import time
from pathlib import Path

from openvocab_occ.cli.output import console, print_json, progress


def city(
    *,
    out: Path,
    seed: int = 7,
    routes: int = 2,
    traversals: int = 3,
    conditions: tuple[str, ...] = ("clear", "rain", "night", "fog", "heavy traffic"),
    frames: int = 40,
    size: tuple[int, int] = (704, 256),
    truth: bool = False,
    json: bool = False,
) -> None:
    """Write the demo city as a nuScenes tree with Occ3D labels; stopped, it goes on where it was.

    Args:
        out: Folder to write, new or one that this command began.
        seed: Of the town.
        routes: How many routes.
        traversals: How often each is driven, a day apart; things come and go between.
        conditions: Of the traversals, in turn: clear, rain, night, fog, "heavy traffic".
        frames: Keyframes of a traversal, two a second, 40 at most.
        size: Width and height of images.
        truth: Write true depth, semantic, instance and part images too.
        json: Print one JSON object.
    """
    from openvocab_occ.datasets.city.writer import CityOptions, write_city

    started = time.perf_counter()
    options = CityOptions(
        seed=seed, routes=routes, traversals=traversals, conditions=conditions, frames=frames, size=size, truth=truth
    )
    with progress("driving through the city", unit="keyframes") as advance:
        report = write_city(out, options, progress=advance)
    report["seconds"] = round(time.perf_counter() - started, 2)
    if json:
        print_json(report)
        return
    say = console().print
    count = f"{len(report['scenes'])} scenes, {report['keyframes']} keyframes ({report['written']} new)"
    say(f"[bold]{out}[/bold]  {count}, {report['boxes']:,} boxes, {report['seconds']:.1f} s  (synthetic data)")
    say(f"map a scene of it:  openvocab-occ map nuscenes {out} --scene {report['scenes'][0]} --encoder ONNX --out MAP")
    say(f"pictures for people:  {out}/sheets")
