"""`openvocab-occ objects`."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from openvocab_occ.cli.output import console, print_json


def objects(
    map: Annotated[Path, tyro.conf.Positional],
    *,
    level: str | None = None,
    state: str | None = None,
    json: bool = False,
) -> None:
    """Print the tree of a map: regions, groups, objects and their parts.

    Args:
        map: A saved map, NAME.ovmap.
        level: Only nodes of this level: region, group, object or part.
        state: Only objects of this state: moving, stopped, parked, fixed or unknown.
        json: Print one JSON object.
    """
    from openvocab_occ.errors import ConfigError
    from openvocab_occ.export.scene_graph import node_dict, scene_graph
    from openvocab_occ.objects.scene_map import SceneMap
    from openvocab_occ.objects.state import STATES
    from openvocab_occ.objects.tree import LEVELS, SceneObject

    if level is not None and level not in LEVELS:
        raise ConfigError("level is not known", expected=" or ".join(LEVELS), got=level)
    if state is not None and state not in STATES:
        raise ConfigError("state is not known", expected=" or ".join(STATES), got=state)
    scene = SceneMap.open(map)
    tree = scene.objects

    def wanted(node: SceneObject) -> bool:
        return (level is None or node.level == level) and (state is None or node.state == state)

    chosen = [(depth, node) for depth, node in tree.walk() if wanted(node)]
    if json:
        graph = scene_graph(scene)
        print_json(graph | {"nodes": [node_dict(node) for _, node in chosen]})
        return
    table = Table("id", "what", "state", "sure", "size m", "at", "seen", "voxels", box=None, pad_edge=False)
    plain = level is not None or state is not None
    for depth, node in chosen:
        size = " x ".join(f"{side:.1f}" for side in node.box.size)
        at = f"({node.center[0]:.1f}, {node.center[1]:.1f})"
        seen = f"{node.times_seen}x, {node.time_observed:.1f} s" if node.times_seen else ""
        speed = f" {node.speed:.1f} m/s" if node.speed else ""
        table.add_row(
            str(node.id), ("" if plain else "  " * depth) + node.label, node.state + speed if node.times_seen else "",
            f"{node.confidence:.2f}" if node.confidence else "", size, at, seen, str(len(node.voxels) or ""),
        )  # fmt: skip
    out = console()
    out.print(f"{scene}\n", markup=False)
    out.print(table)
