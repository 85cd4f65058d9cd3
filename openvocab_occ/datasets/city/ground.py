"""The ground as triangles: road, kerb, sidewalk, square and terrain, cut along lines of equal distance to the road."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.city.mesh import Builder, Mesh, face_uv
from openvocab_occ.datasets.city.streets import CUT, LANE_WIDTH, SIDEWALK_WIDTH, Patch, Plan, Street
from openvocab_occ.datasets.city.surfaces import Material, Part, Surface, linear

KERB = 0.15
"""Height of sidewalks, metres."""
LAWN = 0.12
"""Height of terrain."""
_PAVED = 0.16  # of squares
_PAINT = 0.006  # above the road
_MARGIN = 80.0  # of lawn around the town
_BELOW = -1.2  # of the country around; below any occupancy grid
_COARSE, _MEDIUM, _FINE = 16.0, 2.0, 1.0  # edges of cells, metres
BAY_LENGTH = 6.2
"""Of a parking bay, metres."""
CROSSING = (10.8, 13.6)
"""Where crossings begin and end, metres from the middle of a junction."""
_SURFACES = {
    "road": Surface(Material.ASPHALT, "#66676a"),
    "kerb": Surface(Material.CONCRETE, "#c9c5bb"),
    "sidewalk": Surface(Material.PAVING, "#b0aaa0"),
    "square": Surface(Material.PAVING, "#c2a287"),
    "terrain": Surface(Material.GRASS, "#5f7d3a"),
}
_HEIGHTS = {"road": 0.0, "kerb": KERB, "sidewalk": KERB, "square": _PAVED, "terrain": LAWN}


def ground_meshes(plan: Plan) -> dict[str, Mesh]:
    """Return meshes of `road` (with its markings), `sidewalk` (with kerbs), `square` and `terrain`."""
    corners = _cells(plan)
    xy = corners.reshape(-1, 2)
    fields = np.stack([plan.road_distance(xy), plan.square_distance(xy)], axis=1).reshape(len(corners), 3, 2)
    soup = np.concatenate([corners, fields], axis=2)  # x, y, distance to the road, distance to the square
    road, rest, edge = _split(soup, 2, 0.0)
    kerb, rest, _ = _split(rest, 2, 0.18)
    walk, rest, verge = _split(rest, 2, SIDEWALK_WIDTH)
    square, lawn, rim = _split(rest, 3, 0.0)
    paint = Builder()
    for street in plan.streets:
        _mark_street(paint, plan, street)
    for lot in plan.lots[:1]:
        _mark_lot(paint, lot)
    return {
        "road": _joined([_flat(plan, road, "road"), paint.mesh()]),
        "sidewalk": _joined([
            _flat(plan, walk, "sidewalk"), _flat(plan, kerb, "kerb"), _skirt(edge, "kerb", -0.05, KERB),
        ]),
        "square": _joined([_flat(plan, square, "square"), _skirt(rim, "square", 0.0, _PAVED)]),
        "terrain": _joined([_flat(plan, lawn, "terrain"), _skirt(verge, "terrain", 0.0, KERB), _country(plan)]),
    }  # fmt: skip


def _cells(plan: Plan) -> Float[np.ndarray, "t 3 2"]:
    """Return triangles that cover the town, small where a zone ends."""
    x0, x1, y0, y1 = plan.bounds
    x, y = (
        np.arange(np.floor((a - _MARGIN) / _COARSE), np.ceil((b + _MARGIN) / _COARSE)) for a, b in ((x0, x1), (y0, y1))
    )
    low = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2) * _COARSE
    size, done = _COARSE, []
    while True:
        center = low + size / 2
        road, square = plan.road_distance(center), plan.square_distance(center)
        reach = 0.75 * size + 1.0
        near = (np.abs(road) < reach) | (np.abs(road - SIDEWALK_WIDTH) < reach) | (np.abs(square) < reach)
        if size <= _MEDIUM:
            bends = plan.junction_distance(center) < 24.0
            for lot in (*plan.lots, *plan.squares):
                bends |= np.abs(lot.distance(center)) < 3.0
            near &= bends
        if size <= _FINE:
            near[:] = False
        done.append(np.stack([low[~near], low[~near] + (size, 0), low[~near] + size, low[~near] + (0, size)], axis=1))
        if not near.any():
            break
        size /= 2
        low = (low[near][:, None] + np.array([(0, 0), (size, 0), (0, size), (size, size)])).reshape(-1, 2)
    quads = np.concatenate(done)
    return quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 2)


def _split(soup: np.ndarray, column: int, level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut triangles where a column of their corners passes a level: those below, those above, and the cuts' ends."""
    below = soup[:, :, column] < level
    count = below.sum(axis=1)
    inside, outside, cuts = [soup[count == 3]], [soup[count == 0]], []
    for alone, own, other in ((1, inside, outside), (2, outside, inside)):
        some = soup[count == alone]
        lone = np.argmax(below[count == alone] == (alone == 1), axis=1)
        rolled = some[np.arange(len(some))[:, None], (lone[:, None] + np.arange(3)) % 3]
        a, b, c = rolled[:, 0], rolled[:, 1], rolled[:, 2]
        ab, ac = (
            a + (p - a) * np.clip((level - a[:, column]) / (p[:, column] - a[:, column]), 0, 1)[:, None] for p in (b, c)
        )
        own.append(np.stack([a, ab, ac], axis=1))
        other += [np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)]
        cuts.append(np.stack([ab, ac] if alone == 1 else [ac, ab], axis=1))
    return np.concatenate(inside), np.concatenate(outside), np.concatenate(cuts)


def _flat(plan: Plan, soup: np.ndarray, zone: str) -> Mesh:
    """Return a level surface; the texture of paved zones runs along the nearest street."""
    corners = np.concatenate([soup[:, :, :2], np.full((*soup.shape[:2], 1), _HEIGHTS[zone])], axis=2)
    p, q = soup[:, 1, :2] - soup[:, 0, :2], soup[:, 2, :2] - soup[:, 0, :2]
    size = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    corners, soup = corners[size > 1e-9], soup[size > 1e-9]
    uv = soup[:, :, :2].astype(np.float32)
    if zone not in ("terrain", "square"):
        nearest = plan.distances(soup[:, :, :2].mean(axis=1)).argmin(axis=0)
        for number, street in enumerate(plan.streets):
            own = nearest == number
            s, lateral = street.project(soup[own][:, :, :2].reshape(-1, 2))
            s = s.reshape(-1, 3)
            s = s + np.where(
                s.max(axis=1, keepdims=True) - s > street.length / 2, street.length, 0.0
            )  # across the seam
            uv[own] = np.stack([s, lateral.reshape(-1, 3)], axis=-1)
    return _mesh(corners, uv, _SURFACES[zone], Part.GROUND)


def _skirt(cuts: np.ndarray, zone: str, z0: float, z1: float) -> Mesh:
    """Return the upright faces below the rim of a zone."""
    a, b = cuts[:, 0, :2], cuts[:, 1, :2]
    keep = np.linalg.norm(b - a, axis=1) > 1e-6
    a, b = a[keep], b[keep]
    low, high = np.full((len(a), 1), z0), np.full((len(a), 1), z1)
    p, q, r, s = (np.hstack(pair) for pair in ((a, low), (b, low), (b, high), (a, high)))
    corners = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)])
    return _mesh(corners, face_uv(corners), _SURFACES[zone], Part.GROUND)


def _country(plan: Plan) -> Mesh:
    """Return what lies around the town: meadows that fall away a little, and hills."""
    x0, x1, y0, y1 = plan.bounds
    middle, reach = np.array([(x0 + x1) / 2, (y0 + y1) / 2]), np.hypot(x1 - x0, y1 - y0) / 2 + 120
    angle = np.linspace(0, 2 * np.pi, 97)
    round_ = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    hills = 16 + 9 * np.sin(3 * angle + 1) + 6 * np.sin(7 * angle) + 3 * np.sin(17 * angle)
    b = Builder()
    near = np.hstack([middle + reach * round_, np.full((97, 1), _BELOW)])
    far = np.hstack([middle + (reach + 160) * round_, hills[:, None]])
    i = np.arange(96)
    faces = np.concatenate([np.stack([i, i + 97, i + 98], axis=1), np.stack([i, i + 98, i + 1], axis=1)])
    b.add(np.concatenate([near, far]), faces, Surface(Material.LEAF, "#56713f"), Part.GROUND, solid=False)
    wide = reach + 5
    meadow = [(middle[0] + sx * wide, middle[1] + sy * wide, _BELOW) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    b.sheet(meadow, Surface(Material.GRASS, "#6b8048"), Part.GROUND)
    return b.mesh()


def _mark_street(b: Builder, plan: Plan, street: Street) -> None:
    """Paint the middle line, the bays, the crossings and the stop lines of a street."""
    white = Surface(Material.MARKING, "#e9e7df")
    dashes = np.arange(3.0, street.length - 6.0, 6.0)
    for s in dashes[_clear(plan, street, dashes + 1.5, CUT + 2.0)]:
        _strip(b, street, (s, s + 3.0), (-0.07, 0.07), white)
    for side in (-1, 1) if street.bays else ():
        for s in bay_positions(plan, street, side):
            for line in (s - BAY_LENGTH / 2, s + BAY_LENGTH / 2):
                _strip(b, street, (line - 0.06, line + 0.06), _across(side, LANE_WIDTH, street.half_width), white)
            _strip(b, street, (s - BAY_LENGTH / 2, s - 2.2), _across(side, LANE_WIDTH - 0.06, LANE_WIDTH + 0.06), white)
            _strip(b, street, (s + 2.2, s + BAY_LENGTH / 2), _across(side, LANE_WIDTH - 0.06, LANE_WIDTH + 0.06), white)
    for junction in plan.junctions:
        for arm in junction.arms:
            if plan.streets[arm.street] is street:
                _mark_arm(b, street, arm.s, arm.direction, white)


def _mark_arm(b: Builder, street: Street, middle: float, direction: int, white: Surface) -> None:
    near, far = (middle + direction * r for r in CROSSING)
    for lateral in np.arange(-street.half_width + 0.4, street.half_width - 0.5, 1.0):
        _strip(b, street, (near, far), (lateral, lateral + 0.5), white)
    stop = (middle + direction * (CUT - 0.7), middle + direction * (CUT - 0.3))
    _strip(b, street, stop, _across(direction, 0.1, LANE_WIDTH), white)


def _across(side: int, inner: float, outer: float) -> tuple[float, float]:
    return (inner, outer) if side > 0 else (-outer, -inner)


def _strip(b: Builder, street: Street, s: Iterable[float], lateral: tuple[float, float], surface: Surface) -> None:
    """Paint between two arc lengths and two lateral offsets."""
    low, high = sorted(s)
    steps = np.linspace(low, high, max(2, int((high - low) / 1.6) + 1))
    right, _ = street.at(steps, np.full(len(steps), lateral[0]))
    left, _ = street.at(steps, np.full(len(steps), lateral[1]))
    n = len(steps)
    points = np.hstack([np.concatenate([right, left]), np.full((2 * n, 1), _PAINT)])
    i = np.arange(n - 1)
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], axis=1), np.stack([i, i + n + 1, i + n], axis=1)])
    b.add(points, faces, surface, Part.MARKING, solid=False)


def _clear(plan: Plan, street: Street, s: np.ndarray, distance: float) -> np.ndarray:
    """Tell which arc lengths are farther than so many metres from every junction."""
    return plan.junction_distance(street.at(s)[0]) > distance


def bay_positions(plan: Plan, street: Street, side: int) -> Float[np.ndarray, " n"]:
    """Return the arc lengths of the middles of a street's bays on its left (1) or right (-1) side."""
    if not street.bays:
        return np.zeros(0)
    s = np.arange(BAY_LENGTH, street.length - BAY_LENGTH, BAY_LENGTH)
    away = _clear(plan, street, s, CUT + BAY_LENGTH)
    point, _ = street.at(s, np.full(len(s), side * (street.half_width + 0.5)))
    for lot in plan.lots:
        away &= lot.distance(point) > 4.5
    return s[away]


def lot_places(lot: Patch) -> list[tuple[tuple[float, float], float]]:
    """Return position and heading of the places of a parking lot: two rows of cars and a row for long vehicles."""
    places = [((x, y), yaw) for y, yaw in ((10.0, -np.pi / 2), (0.0, np.pi / 2)) for x in np.arange(-14.0, 15.0, 2.8)]
    places += [((x, -9.6), 0.0) for x in (-9.0, 7.0)]
    c, s = np.cos(lot.yaw), np.sin(lot.yaw)
    return [
        ((float(lot.center[0] + c * x - s * y), float(lot.center[1] + s * x + c * y)), float(yaw + lot.yaw))
        for (x, y), yaw in places
    ]


def _mark_lot(b: Builder, lot: Patch) -> None:
    c, s = np.cos(lot.yaw), np.sin(lot.yaw)
    turn, middle = np.array([[c, -s], [s, c]]), np.asarray(lot.center)
    for y0, y1 in ((7.4, 12.6), (-2.6, 2.6)):
        for x in np.arange(-15.4, 15.5, 2.8):
            corners = np.array([(x - 0.06, y0), (x + 0.06, y0), (x + 0.06, y1), (x - 0.06, y1)]) @ turn.T + middle
            b.sheet(
                list(np.hstack([corners, np.full((4, 1), _PAINT)])), Surface(Material.MARKING, "#e9e7df"), Part.MARKING
            )


def _mesh(corners: np.ndarray, uv: np.ndarray, surface: Surface, part: Part) -> Mesh:
    n = len(corners)
    return Mesh(
        vertices=corners.reshape(-1, 3).astype(np.float64),
        faces=np.arange(3 * n, dtype=np.int32).reshape(-1, 3),
        uv=uv.astype(np.float32),
        material=np.full(n, surface.material, dtype=np.uint8),
        part=np.full(n, part, dtype=np.uint8),
        color=np.tile(linear(surface.color), (n, 1)),
        solid=np.zeros(n, dtype=np.bool_),
        fine=np.zeros(n, dtype=np.bool_),
    )


def _joined(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    faces = np.concatenate([m.faces + np.int32(start) for m, start in zip(meshes, starts, strict=True)])
    vertices, uv, material, part, color, solid, fine = (
        np.concatenate([getattr(m, name) for m in meshes])
        for name in ("vertices", "uv", "material", "part", "color", "solid", "fine")
    )
    return Mesh(vertices, faces, uv, material, part, color, solid, fine)
