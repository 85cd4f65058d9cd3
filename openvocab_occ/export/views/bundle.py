"""View bundles: the map as a camera sees it, in pictures, words and JSON that a program or a language model reads."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args, overload

import numpy as np

from openvocab_occ.errors import ConfigError, MapError
from openvocab_occ.export.brief import RouteBrief, brief_route
from openvocab_occ.export.draw import SKY, paint, relevance_colors
from openvocab_occ.export.overhead import Extent, level, render_overhead
from openvocab_occ.export.questions import questions_about
from openvocab_occ.export.render import MapView, renderer_of
from openvocab_occ.export.route import Route
from openvocab_occ.export.views import pictures as draw
from openvocab_occ.export.views.contents import DEPTH_SCALE, Contents, as_json, file_notes
from openvocab_occ.export.views.lookout import Lookout, default_lookout, ground_height, lookouts_of, standing_at
from openvocab_occ.export.views.marks import LEAST_PIXELS, MOST, Tag, innermost, place_tags
from openvocab_occ.export.views.prompt import messages, picture_names, prompt_text
from openvocab_occ.export.views.seen import SeenObject, position_of, seen_objects
from openvocab_occ.geometry import Camera
from openvocab_occ.io.files import PathLike, written_folder
from openvocab_occ.io.images import write_image
from openvocab_occ.objects.kinds import Kind, kind_of
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query.answer import Answer
from openvocab_occ.query.find import find

MARKER, INDEX = "view.json", "views.json"
NumberBy = Literal["auto", "relevance", "distance"]
_FARTHEST = 65535 / DEPTH_SCALE
_MOST_FIXED = 8  # marks on walls, trees and poles that nobody asked for
_TEXTS = ("prompt.md", "messages.json", "questions.json")


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """What a bundle holds."""

    max_depth: float = 100.0
    """Metres; what lies farther is not drawn. At most 255, the reach of depth.png."""
    marks: bool = True
    """Write numbers on things."""
    bev: bool = True
    """Add a picture from above."""
    table: bool = True
    """List the objects in prompt.md."""
    number_by: NumberBy = "auto"
    """`relevance` numbers hits of the query first, best first, then the others from near to far; `distance` from near
    to far; `auto` by relevance where there is a query."""
    most_marks: int = MOST
    least_pixels: int = LEAST_PIXELS
    """Pixels that a thing must show to be marked."""

    def __post_init__(self) -> None:
        if not 0 < self.max_depth <= _FARTHEST:
            raise ConfigError(
                "max_depth does not fit a depth image", expected=f"0 to {_FARTHEST:.0f} m", got=self.max_depth
            )
        if self.number_by not in get_args(NumberBy):
            raise ConfigError(
                "number_by is not known", expected=" or ".join(get_args(NumberBy)), got=self.number_by
            )  # fmt: skip
        if not 0 <= self.most_marks <= 99 or self.least_pixels < 1:
            raise ConfigError(
                "marks are not usable", expected="0 to 99 marks on things of at least 1 pixel",
                got=(self.most_marks, self.least_pixels),
            )  # fmt: skip


@dataclass(frozen=True)
class ViewBundle:
    """A folder with one view of a map."""

    folder: Path
    view: dict[str, Any]
    """What view.json holds."""

    @classmethod
    def open(cls, folder: PathLike) -> "ViewBundle":
        """Read a bundle that was written.

        Raises MapError where the folder holds none.
        """
        path = Path(folder).expanduser()
        try:
            view = json.loads((path / MARKER).read_text(encoding="utf-8"))
            if view["schema"] != "openvocab_occ.view_bundle":
                raise ValueError(view["schema"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise MapError(f"{path} is not a view bundle", expected=f"a folder with {MARKER}", got=error) from error
        return cls(path, view)

    @property
    def paths(self) -> dict[str, Path]:
        """Every file, by its name."""
        return {name: self.folder / name for name in (MARKER, *_TEXTS, *self.view["files"])}


@dataclass(frozen=True, eq=False)
class _Drawn:
    """One view, ready to be written."""

    contents: Contents
    images: dict[str, np.ndarray]
    view: dict[str, Any]


@overload
def export_views(
    scene: SceneMap,
    out: PathLike,
    *,
    viewpoints: Camera | Lookout | None = ...,
    route: None = ...,
    query: Answer | str | None = ...,
    width: int = ...,
    height: int = ...,
    options: ViewOptions | None = ...,
) -> ViewBundle: ...
@overload
def export_views(
    scene: SceneMap,
    out: PathLike,
    *,
    viewpoints: Sequence[Camera | Lookout] | None = ...,
    route: Route | None = ...,
    query: Answer | str | None = ...,
    width: int = ...,
    height: int = ...,
    options: ViewOptions | None = ...,
) -> list[ViewBundle]: ...
@overload
def export_views(
    scene: SceneMap,
    out: PathLike,
    *,
    viewpoints: Camera | Lookout | Sequence[Camera | Lookout] | None = ...,
    route: Route | None = ...,
    query: Answer | str | None = ...,
    width: int = ...,
    height: int = ...,
    options: ViewOptions | None = ...,
) -> ViewBundle | list[ViewBundle]: ...
def export_views(
    scene: SceneMap,
    out: PathLike,
    *,
    viewpoints: Camera | Lookout | Sequence[Camera | Lookout] | None = None,
    route: Route | None = None,
    query: Answer | str | None = None,
    width: int = 1024,
    height: int = 576,
    options: ViewOptions | None = None,
) -> ViewBundle | list[ViewBundle]:
    """Render the map into folders of pictures and words for a person or a vision-language model.

    One viewpoint, or none, makes `out` a bundle; several, or a route, make a bundle each in folders below `out`, which
    `views.json` there lists, and return a list. `out` appears whole or not at all. One that is there already is
    replaced only if it is of the same kind.

    Args:
        scene: The map.
        out: The folder.
        viewpoints: Cameras, used as they are, or lookouts. Without one, CAM_FRONT (else the first camera) of the middle
            frame, scaled to fit into width x height; of a map without cameras, an overview of that size.
        route: Look ahead from along it, every 20 m; it is drawn in the pictures from above, and `brief.json` beside the
            bundles tells what comes along it.
        query: An answer, or words for `find` (of a `dense` map pass an answer). Its hits are numbered first and drawn
            in gold.
        width: Pixels of cameras that are chosen here.
        height: Pixels.
        options: What a bundle holds.

    Raises:
        ConfigError: The size cannot be, or both viewpoints and a route are given, or none of several.
        AlreadyExistsError: The folder is there and is not ours.
        MapError: The map is empty.
    """
    options = options or ViewOptions()
    if width < 16 or height < 16:
        raise ConfigError("picture is too small", expected="at least 16 x 16 pixels", got=f"{width} x {height}")
    if viewpoints is not None and route is not None:
        raise ConfigError("a view is from one place", expected="viewpoints or a route", got="both")
    if not len(scene.voxels):
        raise MapError("the map has no voxels to render", fix="map at least one frame with an occupancy grid or depth")
    answer = find(scene, query) if isinstance(query, str) else query
    if route is not None:
        stands = [
            replace(standing_at(scene, T, width, height), name=f"route_{station:03.0f}m", method="ahead",
                    reason=f"{station:.0f} m along the route, looking along it")
            for station, T in route.stands(20.0)
        ]  # fmt: skip
    elif viewpoints is None:
        stands = [default_lookout(scene, width, height)]
    else:
        stands = lookouts_of(viewpoints)
    if not stands:
        raise ConfigError("there is no viewpoint", expected="at least 1", got=0)
    path = None if route is None else route.points
    target = Path(out).expanduser()
    if route is None and (viewpoints is None or isinstance(viewpoints, Camera | Lookout)):
        drawn = _draw(scene, stands[0], answer, options, path)
        with written_folder(target, marker=MARKER) as folder:
            _write(drawn, folder, options)
        return ViewBundle(target, drawn.view)
    names = [f"{number:02d}_{_slug(stand.name)}" for number, stand in enumerate(stands)]
    views = []
    brief = None if route is None else brief_route(scene, route)
    with written_folder(target, marker=INDEX) as folder:
        for name, stand in zip(names, stands, strict=True):
            (folder / name).mkdir()
            drawn = _draw(scene, stand, answer, options, path)
            _write(drawn, folder / name, options, brief)
            views.append(drawn.view)
        index = [{"folder": name, **view["viewpoint"]} for name, view in zip(names, views, strict=True)]
        if brief is not None:
            (folder / "brief.json").write_text(as_json(brief.to_dict()), encoding="utf-8")
        (folder / INDEX).write_text(as_json({"schema": "openvocab_occ.views", "views": index}), encoding="utf-8")
    return [ViewBundle(target / name, view) for name, view in zip(names, views, strict=True)]


def _draw(
    scene: SceneMap, stand: Lookout, answer: Answer | None, options: ViewOptions, path: np.ndarray | None
) -> _Drawn:
    view = renderer_of(scene).view(stand.camera, options.max_depth)
    filled = renderer_of(scene, filled=True).view(stand.camera, options.max_depth)
    surface = view.surface
    seen = seen_objects(view, scene.objects, stand.T_world_ego[:3, 3])
    hits = [] if answer is None else [hit.object.id for hit in answer.hits if not hit.undecided]
    order = _order(seen, hits, options)
    spots = {one.object.id: _spot(view, one) for one in order}
    while True:
        marks = {one.object.id: number for number, one in enumerate(order, start=1)}
        points = {id: position_of(view, spots[id]) for id in marks}
        extent = Extent.around(
            draw.ego_points_of(level(stand.T_world_ego), points.values()), reach=options.max_depth
        )  # fmt: skip
        ground = ground_height(scene, stand.T_world_ego[:2, 3])
        overhead = render_overhead(scene, surface, stand.T_world_ego, extent, ground=ground)
        anchors = {mark: (float(spots[id][0]), float(spots[id][1])) for id, mark in marks.items()}
        tags = place_tags(view.item.shape, anchors, draw.areas_of(view.item, marks))
        gold = [marks[id] for id in hits if id in marks]
        bev, bev_tags = draw.marked_overhead(
            overhead, draw.overhead_base(overhead, surface), stand.camera,
            {mark: scene.objects[id] for id, mark in marks.items()}, {marks[id]: p for id, p in points.items()},
            gold, path, marks=options.marks,
        )  # fmt: skip
        placed = {tag.mark for tag in tags} & ({tag.mark for tag in bev_tags} if options.marks else set(marks.values()))
        if len(placed) == len(marks):
            break
        order = [one for one in order if marks[one.object.id] in placed]  # no room: a picture of a few pixels
    contents = Contents(scene, stand, view, overhead, seen, marks, {id: spots[id] for id in marks}, answer,
                        options.max_depth, options.least_pixels)  # fmt: skip
    clean = draw.clean_view(filled, surface)
    images: dict[str, np.ndarray] = {
        "view_clean.png": clean,
        "view_rgb.png": paint(filled, surface.colors, SKY),
        "semantic.png": paint(view, surface.palette),
        "instance.png": draw.instance_image(view, seen),
        "depth.png": draw.depth_image(view),
    }
    if options.marks:
        images["view_marked.png"] = draw.marked_view(clean, view.item, marks, tags, hits)
    if options.bev:
        images["bev_marked.png"] = bev
    if answer is not None:
        scores = {hit.object.id: float(hit.score) for hit in answer.hits}
        images["relevance.png"] = paint(filled, relevance_colors(surface, scores), SKY)
    for one in order:
        images[f"crops/{marks[one.object.id]}.png"] = draw.crop(clean, one, view.item)
    files = file_notes(marks=options.marks, bev=options.bev, query=answer is not None, crops=sorted(marks.values()))
    where = {"view_marked.png": _tags(tags) if options.marks else [], "bev_marked.png": _tags(bev_tags)}
    return _Drawn(contents, images, contents.to_dict(files, {k: v for k, v in where.items() if k in files}))


def _order(seen: Sequence[SeenObject], hits: Sequence[int], options: ViewOptions) -> list[SeenObject]:
    """Return what is marked, in the order of its numbers.

    Of too many those stay that answer the query, then what can move, then what shows most.
    """
    rank = {id: number for number, id in enumerate(hits)}
    large = [
        one
        for one in seen
        if one.pixels >= options.least_pixels and (one.object.id in rank or kind_of(one.object.label) != Kind.GROUND)
    ]

    def worth(one: SeenObject) -> tuple[int, int, int]:
        moves = kind_of(one.object.label) == Kind.MOVABLE
        return rank.get(one.object.id, len(rank)), -int(moves), -one.pixels

    kept: set[int] = set()
    fixed = 0
    for one in sorted(large, key=worth):
        still = one.object.id not in rank and kind_of(one.object.label) == Kind.FIXED
        fixed += still
        if len(kept) < options.most_marks and not (still and fixed > _MOST_FIXED):
            kept.add(one.object.id)
    chosen = [one for one in large if one.object.id in kept]  # near to far
    if options.number_by == "distance":
        return chosen
    return sorted(chosen, key=lambda one: rank.get(one.object.id, len(rank)))


def _spot(view: MapView, one: SeenObject) -> tuple[int, int]:
    left, top, right, bottom = one.box
    u, v, _ = innermost(view.item[top : bottom + 1, left : right + 1] == one.object.id)
    return left + u, top + v


def _tags(tags: Sequence[Tag]) -> list[dict[str, Any]]:
    return [
        {"mark": tag.mark, "tag": list(tag.box), "at": [round(x, 1) for x in tag.anchor], "leader": tag.leader}
        for tag in tags
    ]


def _write(drawn: _Drawn, folder: Path, options: ViewOptions, brief: RouteBrief | None = None) -> None:
    for name, image in drawn.images.items():
        (folder / name).parent.mkdir(exist_ok=True)
        write_image(folder / name, image)
    (folder / MARKER).write_text(as_json(drawn.view), encoding="utf-8")
    text = prompt_text(drawn.view, marks=options.marks, bev=options.bev, table=options.table)
    (folder / "prompt.md").write_text(text, encoding="utf-8")
    shown = [folder / name for name in picture_names(marks=options.marks, bev=options.bev)]
    (folder / "messages.json").write_text(json.dumps(messages(text, shown), ensure_ascii=False), encoding="utf-8")
    questions = {"schema": "openvocab_occ.questions", "questions": questions_about(drawn.view, brief)}
    (folder / "questions.json").write_text(as_json(questions), encoding="utf-8")


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:40] or "view"
