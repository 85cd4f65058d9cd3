"""Words and small tables of the page, as HTML in which every text that comes from data is escaped."""

import html
import re
from collections.abc import Iterable, Sequence

import numpy as np

from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.query.find import Answer, Hit

LISTED = 8
"""Hits in the list."""
_KNOWN_SHOWN = 20
_BAR_PX = 44  # width of a score of 1
_BAR_COLOR = "#0072b2"


def escape(text: object) -> str:
    """Return text as HTML that shows exactly these letters, on one line."""
    return html.escape(" ".join(str(text).split()), quote=True)


def escape_markdown(text: object) -> str:
    """Return text as markdown that shows exactly these letters: no markup, no HTML, one line.

    viser puts raw HTML of markdown into the page, so every letter that could begin some is written by its number.
    """
    return re.sub(r"[^\w\s]|_", lambda found: f"&#{ord(found[0])};", " ".join(str(text).split()))


def block(inner: str, *, small: bool = False) -> str:
    """Return HTML as one block of the panel."""
    return f'<div style="padding:2px 10px;font-size:{11 if small else 12.5}px;line-height:1.4">{inner}</div>'


def preformatted(text: str) -> str:
    """Return lines as they are, in letters of one width."""
    return (
        '<pre style="margin:0;padding:2px 10px;font-size:10.5px;line-height:1.35;white-space:pre-wrap;'
        f'overflow-wrap:anywhere">{html.escape(text, quote=True)}</pre>'
    )


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """Return a table of names and values."""
    rows = "".join(
        f'<tr><td style="opacity:.65;padding-right:8px;white-space:nowrap;vertical-align:top">{escape(name)}</td>'
        f'<td style="overflow-wrap:anywhere">{escape(value)}</td></tr>'
        for name, value in pairs
    )
    return block(f'<table style="border-spacing:0 1px">{rows}</table>')


def swatches(entries: Iterable[tuple[Sequence[int], str, str]]) -> str:
    """Return colours with their names and a number each, as a list."""
    rows = "".join(
        f'<tr><td><span style="display:inline-block;width:11px;height:11px;border-radius:2px;'
        f'background:#{bytes(color).hex()}"></span></td><td style="padding:0 8px 0 6px">{escape(name)}</td>'
        f'<td style="text-align:right;opacity:.65">{escape(number)}</td></tr>'
        for color, name, number in entries
    )
    return f'<table style="border-spacing:0">{rows}</table>'


def ramp(colors: np.ndarray, ends: tuple[str, str, str], title: str) -> str:
    """Return a scale of colours with the numbers at its ends and middle."""
    stops = ",".join(f"#{bytes(color).hex()}" for color in colors.astype(np.uint8).tolist())
    numbers = "".join(f"<span>{escape(number)}</span>" for number in ends)
    return (
        f'<div>{escape(title)}</div><div style="height:10px;border-radius:2px;'
        f'background:linear-gradient(90deg,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{numbers}</div>'
    )


def answer_line(answer: Answer) -> str:
    """Say in one line how many objects answer, how surely, and what was not understood."""
    took = f"{1000 * answer.seconds:.0f} ms"
    more = f"<br>not understood: {', '.join(map(escape, answer.unknown))}" if answer.unknown else ""
    if answer.verdict == "unknown words":
        known = ", ".join(map(escape, answer.known[:_KNOWN_SHOWN]))
        return f"<b>not understood:</b> {', '.join(map(escape, answer.unknown))}" + (
            f"<br>this map knows: {known}" if known else ""
        )
    if answer.hits:
        count, undecided = len(answer.hits), sum(hit.undecided for hit in answer.hits)
        line = f"<b>{count} object{'s' * (count != 1)}</b>, {took}, threshold {answer.threshold:.2f}"
        return line + (f"<br>{undecided} undecided: not all that was asked was observed" if undecided else "") + more
    if answer.verdict == "unobserved":
        seen = "" if answer.region_seen is None else f": {answer.region_seen:.0%} of that place was seen"
        return f"<b>not observed there</b>{seen}, {took}{more}"
    best = "no objects in this map" if answer.best is None else f"best {answer.best:.2f}"
    return f"<b>{escape(answer.verdict)}:</b> {best}, threshold {answer.threshold:.2f}, {took}{more}"


def hit_table(scene: SceneMap, hits: Sequence[Hit]) -> str:
    """Return the first hits as a table: rank, object, state, score as a bar, distance from the drive."""
    rows = []
    for rank, hit in enumerate(hits[:LISTED], start=1):
        away = distance_to_path(scene, hit.object)
        width = round(_BAR_PX * float(np.clip(hit.score, 0, 1)))
        label = escape(hit.object.label or "object")
        mark = "?" if hit.undecided else ""
        rows.append(
            f'<tr><td style="text-align:right">{rank}</td>'
            f'<td style="padding-left:4px;max-width:76px;overflow:hidden;text-overflow:ellipsis" title="{label}">'
            f'{label}</td><td style="padding:0 4px">#{hit.object.id}{mark}</td>'
            f"<td>{escape(hit.object.state)}</td>"
            f'<td style="padding:0 4px"><div style="width:{_BAR_PX}px;background:rgba(128,128,128,.25)">'
            f'<div style="height:8px;width:{width}px;background:{_BAR_COLOR}"></div></div></td>'
            f"<td>{hit.score:.2f}</td>"
            f'<td style="text-align:right;padding-left:4px">{"" if away is None else f"{away:.0f}&nbsp;m"}</td></tr>'
        )
    rest = len(hits) - LISTED
    table = f'<table style="border-spacing:0 1px;white-space:nowrap;width:100%">{"".join(rows)}</table>'
    return block(table + (f"and {rest} more" if rest > 0 else ""), small=True)


def distance_to_path(scene: SceneMap, item: SceneObject) -> float | None:
    """Return the metres from an object's centre to the nearest pose of the ego; None where the map has no frames."""
    path = np.array([frame.T_world_ego[:3, 3] for frame in scene.frames])
    return float(np.linalg.norm(path - np.asarray(item.center), axis=1).min()) if len(path) else None


def provenance_line(scene: SceneMap) -> str:
    """Say what the map was made from; synthetic input is named as such."""
    counts = [
        f"{len(scene.voxels):,} voxels of {scene.voxels.voxel_size:g} m",
        f"{len(scene.objects)} objects",
        f"{len(scene.frames)} frame{'s' * (len(scene.frames) != 1)}",
        f"encoder {escape(scene.encoder.name)}",
    ]
    made = scene.provenance
    words = [escape(word) for word in (made.source, made.name) if word] + counts
    return ("<b>Synthetic input.</b> " if made.synthetic else "") + ", ".join(words)
