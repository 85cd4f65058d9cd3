"""`openvocab-occ export views`, and `brief`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from openvocab_occ.cli.encoder import encoder_for
from openvocab_occ.cli.output import console, print_json

Place = Literal["front", "rig", "trajectory", "route", "ahead", "object", "hits"]


def views(
    map: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    place: Place = "front",
    query: str | None = None,
    encoder: Path | None = None,
    card: Path | None = None,
    frame: int | None = None,
    metres: float | None = None,
    object: int | None = None,
    size: tuple[int, int] = (1024, 576),
    number_by: Literal["auto", "relevance", "distance"] = "auto",
    leave_out: tuple[Literal["marks", "bev", "table"], ...] = (),
    json: bool = False,
) -> None:
    """Render semantic views of a map for a person or a vision-language model.

    Args:
        map: A saved map, NAME.ovmap.
        out: Folder to write: pictures, depth, instance ids, view.json, prompt.md, messages.json, questions.json.
        place: Where to look from. front: the front camera of one frame; rig: all of its cameras; trajectory: along the
            drive every METRES; route: along the way ahead of a frame for METRES; ahead: METRES ahead on that way;
            object: the best view of OBJECT; hits: few views that show the hits of QUERY.
        query: Put the answer to this into the bundle.
        encoder: The ONNX model that made the map; needed where words become vectors (dense models), except where the
            shipped model made it.
        card: The model's card, if it does not lie beside it.
        frame: Index of the frame to stand at; the middle one by default, for routes the first.
        metres: Distance or spacing, see PLACE; 20, for a route 100.
        object: Id of an object.
        size: Width and height, pixels.
        number_by: What the marks are numbered by.
        leave_out: What the pictures and the prompt go without.
        json: Print one JSON object.
    """
    from openvocab_occ.errors import ConfigError
    from openvocab_occ.export.route import route_ahead
    from openvocab_occ.export.views import ViewBundle, ViewOptions, choose, export_views, lookout
    from openvocab_occ.objects.scene_map import SceneMap
    from openvocab_occ.query.find import find

    scene = SceneMap.open(map)
    model = encoder_for(map, encoder, card)
    answer = find(scene, query, model) if query else None
    options = ViewOptions(number_by=number_by, **dict.fromkeys(leave_out, False))
    width, height = size
    route, stands = None, None
    middle = scene.frames[len(scene.frames) // 2].index if scene.frames else 0
    match place:
        case "front" if frame is not None:
            stands = lookout.rig(scene, frame, width, height)
            stands = next((one for one in stands if one.name == lookout.FRONT), stands[0])
        case "front":
            pass
        case "rig":
            stands = lookout.rig(scene, middle if frame is None else frame, width, height)
        case "trajectory":
            stands = choose.along_trajectory(scene, spacing=metres or 20.0, width=width, height=height)
        case "route":
            route = route_ahead(scene, frame=frame, length=metres or 100.0)
        case "ahead":
            stands = choose.ahead(scene, metres or 20.0, frame=frame, width=width, height=height)
        case "object":
            if object is None:
                raise ConfigError("which object is not said", expected="--object ID")
            stands = choose.looking_at(scene, object, width=width, height=height)
        case "hits":
            if answer is None or not answer.hits:
                raise ConfigError("there are no hits to show", expected="--query with hits", got=query)
            ids = [hit.object.id for hit in answer.hits]
            stands = list(choose.covering(scene, ids, width=width, height=height).lookouts)
    bundles = export_views(
        scene, out, viewpoints=stands, route=route, query=answer, width=width, height=height, options=options
    )
    bundles = [bundles] if isinstance(bundles, ViewBundle) else bundles
    told = [
        {
            "folder": str(bundle.folder),
            "viewpoint": bundle.view["viewpoint"],
            "marks": sum(item["mark"] is not None for item in bundle.view["objects"]),
        }
        for bundle in bundles
    ]
    if json:
        files = sorted(p.name for p in bundles[0].folder.iterdir())
        print_json(
            {"folder": str(out), "bundles": told, "files": files, "answer": answer.to_dict() if answer else None}
        )
        return
    for one in told:
        console().print(
            f"[bold]{one['folder']}[/bold]  {one['viewpoint']['reason']}; {one['marks']} marks", soft_wrap=True
        )  # fmt: skip


def brief(
    map: Annotated[Path, tyro.conf.Positional],
    *,
    frame: int | None = None,
    length: float = 100.0,
    json: bool = False,
) -> None:
    """Tell what comes along the way ahead: objects by station and side, junctions, what nobody has seen.

    Args:
        map: A saved map, NAME.ovmap.
        frame: Index of the frame that the ego is at; the first by default.
        length: Metres.
        json: Print one JSON object.
    """
    from openvocab_occ.export.brief import brief_route
    from openvocab_occ.objects.scene_map import SceneMap

    told = brief_route(SceneMap.open(map), frame=frame, length=length)
    if json:
        print_json(told.to_dict())
    else:
        console().print(told.text(), markup=False, soft_wrap=True)


def mcp(
    map: Annotated[Path, tyro.conf.Positional],
    *,
    encoder: Path | None = None,
    card: Path | None = None,
    other: Path | None = None,
    out: Path | None = None,
    json: bool = False,
) -> None:
    """Serve a map to agents over the Model Context Protocol, on standard input and output.

    Args:
        map: A saved map, NAME.ovmap.
        encoder: The ONNX model that made the map; needed where words become vectors (dense models), except where the
            shipped model made it.
        card: The model's card, if it does not lie beside it.
        other: A second map of the same place, that `diff` may compare with.
        out: Folder for pictures; a temporary one by default.
        json: Print the tools with the schemas of their arguments as one JSON object, and serve nothing.
    """
    from openvocab_occ.export.mcp_server import MapTools, described, server

    model = encoder_for(map, encoder, card)
    maps = {"map": map} | ({"other": other} if other else {})
    made = server(MapTools(maps, model, out))
    if json:
        print_json({"tools": described(made)})
    else:
        made.run("stdio")
