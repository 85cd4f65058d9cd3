"""What is known of an object or a voxel, as facts for the page and as JSON."""

import json
from typing import TYPE_CHECKING

import numpy as np

from openvocab_occ.export.scene_graph import node_dict
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import OBJECT, SceneObject
from openvocab_occ.viewer.content import Content

if TYPE_CHECKING:
    from collections.abc import Iterator

_NEIGHBOURS = 6
_WORDS = 5  # best labels of a voxel or an object
_FAR = 25.0  # metres; what is farther is no neighbour


def object_facts(content: Content, item: SceneObject) -> list[tuple[str, object]]:
    """Return names and values of what is known of an object."""
    rows: list[tuple[str, object]] = [
        ("level", item.level),
        ("label", f"{item.label or 'none'} ({item.score:.2f})"),
        ("state", f"{item.state}{f' ({item.confidence:.2f})' if item.confidence else ''}"),
    ]
    if item.evidence:
        rows.append(("because", item.evidence))
    if item.names:
        rows.append(("words", ", ".join(f"{name} {score:.2f}" for name, score in item.names[:_WORDS])))
    else:
        rows.append(
            ("words", ", ".join(f"{name} {score:.2f}" for name, score in similarities(content, item.embedding)))
        )
    x, y, z = item.center
    length, width, height = item.box.size
    rows += [
        ("centre", f"{x:.1f}, {y:.1f}, {z:.1f} m"),
        ("size", f"{length:.1f} × {width:.1f} × {height:.1f} m, yaw {np.degrees(item.box.yaw):.0f}°"),
        ("voxels", f"{len(item.voxels):,}"),
    ]
    if len(content.path):
        rows.append(("from the drive", f"{float(np.linalg.norm(content.path - item.center, axis=1).min()):.1f} m"))
    if item.speed:
        rows.append(("speed", f"{item.speed:.1f} m/s"))
    if item.times_seen:
        seen = f"{item.times_seen} times in {item.time_observed:.1f} s"
        rows.append(("seen", f"{seen}, agreement {item.agreement:.2f}"))
    return rows


def voxel_facts(content: Content, voxel: int) -> list[tuple[str, object]]:
    """Return names and values of what is known of a voxel."""
    voxels, scene = content.scene.voxels, content.scene
    semantics = content.semantics
    label = int(semantics.labels[voxel])
    x, y, z = voxels.centers[voxel]
    odds = float(voxels.log_odds[voxel])
    rows: list[tuple[str, object]] = [
        ("label", semantics.names[label] if label >= 0 else "none"),
        ("words", ", ".join(f"{word} {score:.2f}" for word, score in similarities(content, voxels.features[voxel]))),
        ("centre", f"{x:.2f}, {y:.2f}, {z:.2f} m"),
        ("occupied", f"{1 / (1 + np.exp(-odds)):.2f} by {voxels.count[voxel]} hits, {voxels.free_count[voxel]} misses"),
        ("weight", f"{voxels.weight[voxel]:.1f} pixels, agreement {voxels.agreement[voxel]:.2f}"),
        ("seen", f"for {voxels.last_seen[voxel] - voxels.first_seen[voxel]:.1f} s"),
    ]
    if len(scene.class_names) and voxels.labels[voxel] < len(scene.class_names):
        rows.append(("occupancy", scene.class_names[voxels.labels[voxel]]))
    counts = voxels.label_counts[voxel] if voxels.num_classes else np.zeros(0)
    if counts.sum() and len(np.flatnonzero(counts)) > 1:
        order = [int(i) for i in np.argsort(-counts.astype(int), kind="stable")[:3] if counts[i]]
        rows.append(("frames said", ", ".join(f"{scene.class_names[i]} {counts[i]}" for i in order)))
    return rows


def similarities(content: Content, feature: np.ndarray) -> list[tuple[str, float]]:
    """Return the words nearest to a feature: the model's labels, or the occupancy's classes by its text side."""
    words, vectors = _vocabulary(content)
    if not len(words):
        return []
    scores = vectors @ feature
    return [(words[i], float(scores[i])) for i in np.argsort(-scores, kind="stable")[:_WORDS]]


def relatives(scene: SceneMap, item: SceneObject) -> "Iterator[tuple[str, int]]":
    """Yield what stands above, below and beside an object, with its id."""
    if item.parent:
        parent = scene.objects[item.parent]
        yield f"in {parent.label or parent.level} #{parent.id}", parent.id
    for child in item.children[:_NEIGHBOURS]:
        node = scene.objects[child]
        yield f"holds {node.label or node.level} #{child}", child
    others = [other for other in scene.objects.level(OBJECT) if other.id != item.id]
    if not others:
        return
    away = np.linalg.norm(np.array([other.center for other in others]) - item.center, axis=1)
    for at in np.argsort(away, kind="stable")[:_NEIGHBOURS]:
        if away[at] <= _FAR:
            yield f"{away[at]:.1f} m: {others[at].label or 'object'} #{others[at].id}", others[at].id


def object_json(item: SceneObject) -> str:
    """Return an object as indented JSON."""
    return json.dumps(node_dict(item), indent=1, ensure_ascii=False, default=str)


def _vocabulary(content: Content) -> tuple[tuple[str, ...], np.ndarray]:
    scene = content.scene
    if scene.encoder.contract == "logits":
        return scene.encoder.labels, np.eye(scene.encoder.dim, dtype=np.float32)
    text = getattr(content.encoder, "text", None)
    words = tuple(name for name in scene.class_names if name not in ("free", "others", "occupied"))
    unknown = getattr(text, "unknown_words", None)  # optional in the protocol
    words = words if unknown is None else tuple(word for word in words if not unknown(word))
    if text is None or not words:
        return (), np.zeros((0, scene.encoder.dim), np.float32)
    kept = content.vectors.get(words)
    if kept is None:
        vectors = np.asarray(text.encode(list(words)), np.float32)
        kept = content.vectors[words] = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return words, kept
