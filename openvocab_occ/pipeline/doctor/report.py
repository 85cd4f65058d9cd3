"""The report as a page: findings, estimates and pictures."""

import html
from typing import TYPE_CHECKING

from openvocab_occ.io.files import PathLike, written_folder
from openvocab_occ.io.images import write_image
from openvocab_occ.pipeline.doctor.finding import LEVELS

if TYPE_CHECKING:
    from openvocab_occ.pipeline.doctor.examine import Diagnosis

PAGE = "index.html"
_COLORS = {"ok": "#2e7d32", "note": "#1565c0", "warning": "#e65100", "error": "#b71c1c"}
_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:1200px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;width:100%}td{padding:.4em .6em;border-top:1px solid #ddd;vertical-align:top}
img{max-width:100%;border:1px solid #ccc;margin:.3em 0 1em}.l{color:#fff;border-radius:3px;padding:0 .5em}
small{color:#555}"""
_TITLES = {
    "lidar_on_images.png": "LiDAR on the images: edges of points must lie on edges of things",
    "grid_on_images.png": "The grid's depth on the images: things and their voxels must coincide",
    "depth_agreement.png": "Measured depth of two views, and the first in the second",
    "images.png": "Images of the first frame",
    "from_above.png": "The frames looked at, from above",
}


def write(diagnosis: "Diagnosis", folder: PathLike) -> None:
    """Write the page and its pictures, whole or not at all; an older report there is replaced."""
    with written_folder(folder, marker=PAGE) as scratch:
        pictures = diagnosis.pictures()
        for name, image in pictures.items():
            write_image(scratch / name, image)
        (scratch / PAGE).write_text(page(diagnosis, list(pictures)), encoding="utf-8")


def page(diagnosis: "Diagnosis", pictures: list[str]) -> str:
    """Return the HTML page."""
    title = html.escape(f"{diagnosis.name} ({diagnosis.source})")
    rows = "\n".join(
        f'<tr><td><span class="l" style="background:{_COLORS[f.level]}">{f.level}</span></td>'
        f"<td>{html.escape(f.check)}</td><td>{html.escape(f.what)}"
        + (f"<br><small>{html.escape(f.why)}</small>" if f.why else "")
        + (f"<br><b>Try:</b> {html.escape(f.advice)}" if f.advice else "")
        + "</td></tr>"
        for f in sorted(diagnosis.findings, key=lambda f: -LEVELS.index(f.level))
    )
    images = "\n".join(
        f'<h3>{html.escape(_TITLES[name])}</h3><a href="{name}"><img src="{name}" alt="{name}"></a>'
        for name in pictures
    )
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        f"</head><body><h1>{title}</h1><p>{html.escape(summary(diagnosis))}</p><table>{rows}</table>{images}"
        "</body></html>\n"
    )


def summary(diagnosis: "Diagnosis") -> str:
    """Return in a sentence or two what was found and what a map will cost."""
    bad = [f for f in diagnosis.findings if f.level in ("warning", "error")]
    said = f"{len(diagnosis.sample.frames)} of {diagnosis.sample.total} frames looked at: "
    said += "nothing looks wrong." if not bad else f"{len(bad)} thing{'s' * (len(bad) > 1)} look wrong."
    cost = diagnosis.estimate
    if cost is not None:
        said += (
            f" A map will have about {cost.voxels:,} voxels of {cost.voxel_size:g} m: {cost.megabytes_labels:,.1f} MB "
            f"with labels, {cost.megabytes_dense:,.1f} MB with 768 features a voxel before they are compressed. "
            f"Reading and ray casting take about {_duration(cost.read_seconds)} here; the 2D model runs "
            f"{cost.images:,} times on top."
        )
    return said


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
