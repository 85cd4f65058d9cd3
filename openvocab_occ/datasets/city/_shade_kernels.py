"""Colour of ray hits: procedural textures, sun, sky, lamps, haze. Linear light; pictures, not measurements.

`light` is the vector that `weather.light_vector` fills; the offsets below name its entries.
"""

import math
from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

SUN, SUN_COLOR, ZENITH, HORIZON, BOUNCE, HAZE, HAZE_COLOR = 0, 3, 6, 9, 12, 15, 16
WET, NIGHT, CLOUDS, EXPOSURE, AMBIENT, DRIFT, SIZE = 19, 20, 21, 22, 23, 24, 25
PLAIN, PAINT, GLASS, METAL, ASPHALT, MARKING, PAVING, GRASS, BRICK, PLASTER = 0, 1, 2, 4, 5, 6, 7, 8, 9, 10
TILES, LEAF, BARK, WOOD, CONCRETE, WINDOW, LAMP, HEADLIGHT, TAILLIGHT, SIGN = 11, 12, 13, 14, 15, 16, 17, 18, 19, 20


@kernel
@no_type_check
def _hash(x, y, z):
    """Return a number in [0, 1) that looks random and is always the same."""
    h = np.uint32(x) * np.uint32(374761393) + np.uint32(y) * np.uint32(668265263) + np.uint32(z) * np.uint32(2147483647)
    h = np.uint32(h)
    h = np.uint32(np.uint32(h ^ np.uint32(h >> np.uint32(13))) * np.uint32(1274126177))
    return np.float32(np.uint32(h ^ np.uint32(h >> np.uint32(16))) & np.uint32(0xFFFFFF)) * np.float32(1 / 16777216)


@kernel
@no_type_check
def noise(x, y, s):
    """Return smooth noise in [0, 1]: hashes of the corners of a unit lattice, blended; s picks one of many."""
    fx, fy = math.floor(x), math.floor(y)
    u, v = x - fx, y - fy
    i, j = np.int64(fx), np.int64(fy)
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    a, b = _hash(i, j, s), _hash(i + 1, j, s)
    c, d = _hash(i, j + 1, s), _hash(i + 1, j + 1, s)
    return (a + (b - a) * u) * (1 - v) + (c + (d - c) * u) * v


@kernel
@no_type_check
def _fade(footprint, frequency):
    """Return how much of a pattern survives a pixel of so many metres."""
    q = 1.6 * footprint * frequency
    return 1.0 / (1.0 + q * q * q)


@kernel
@no_type_check
def _clip(x):
    return min(max(x, 0.0), 1.0)


@kernel
@no_type_check
def _sky(dx, dy, dz, light, clouds, out):
    """Put the colour of the sky in a direction into out: a gradient, the glow of the sun, a layer of clouds."""
    k = (1.0 - min(max(dz, 0.0), 1.0)) ** 3
    s = max(dx * light[SUN] + dy * light[SUN + 1] + dz * light[SUN + 2], 0.0)
    s2 = s * s
    s8 = s2 * s2 * s2 * s2
    glow = 0.35 * s8 + 1.2 * s8**38
    m = 0.0
    if clouds and light[CLOUDS] > 0 and dz > 0.015:
        x, y = dx / (dz + 0.12) * 1.3 + light[DRIFT], dy / (dz + 0.12) * 1.3
        n = 0.5 * noise(x, y, 7) + 0.25 * noise(2.1 * x, 2.1 * y, 8) + 0.15 * noise(4.3 * x, 4.3 * y, 9)
        n += 0.1 * noise(9 * x, 9 * y, 10)
        m = 0.85 * _clip((n - 1.0 + light[CLOUDS]) * 3.2) * _clip(dz * 9.0)
    for c in range(3):
        blue = light[ZENITH + c] * (1 - k) + light[HORIZON + c] * k
        white = light[SUN_COLOR + c] * 0.22 + light[HORIZON + c] * 0.75
        out[c] = blue * (1 - m) + white * m + light[SUN_COLOR + c] * glow * 0.35 * (1 - m / 0.85)


@kernel
@no_type_check
def _road(u, v, fp):
    """Return the brightness of asphalt: grain, patches, wheel tracks beside the middle of each lane, a few cracks."""
    g = 1 + 0.42 * (noise(u * 28, v * 28, 1) - 0.5) * _fade(fp, 28)
    g += 0.28 * (noise(u * 0.35, v * 0.9, 2) - 0.5) + 0.22 * (noise(u * 2.3, v * 2.3, 3) - 0.5)
    track = abs(abs(v) - 1.75) - 0.8
    g *= 1 - 0.1 * math.exp(-track * track * 6)
    if noise(u * 0.13, v * 0.3, 21) > 0.74:
        g *= 0.84
    crack = abs(noise(u * 0.8 + 0.4 * noise(u * 5, v * 5, 34), v * 0.8, 22) - 0.5)
    if crack < 0.006 and noise(u * 0.17, v * 0.17, 35) > 0.62:
        g *= 1 - 0.4 * _fade(fp, 8)
    return g


@kernel
@no_type_check
def _rows(u, v, width, height, fp, frequency, seed):
    """Return of a bond of bricks: brightness of this one, distance from its left and lower joint, fade."""
    r = math.floor(v / height)
    x = u / width + 0.5 * (r % 2)
    i = math.floor(x)
    return _hash(int(i), int(r), seed) - 0.5, x - i, v / height - r, _fade(fp, frequency)


@kernel
@no_type_check
def _texture(material, u, v, fp, a):
    """Multiply the albedo a by the pattern of its material at (u, v) metres; return the gloss."""
    g, gloss = 1.0, 0.0
    if material == ASPHALT:
        g, gloss = _road(u, v, fp), 0.25
    elif material == MARKING:
        worn = _clip((noise(u * 9, v * 9, 4) - 0.5) * 3) * _fade(fp, 9)
        g, gloss = 1 - 0.3 * worn - 0.12 * noise(u * 1.1, v * 1.1, 5), 0.3
    elif material == PAVING:
        h, x, y, j = _rows(u, v, 0.9, 0.6, fp, 3, 6)
        g = 1 + 0.2 * j * h + 0.16 * (noise(u * 0.7, v * 0.7, 12) - 0.5)
        g += 0.14 * (noise(u * 14, v * 14, 11) - 0.5) * _fade(fp, 14)
        if min(min(x, 1 - x) * 0.9, min(y, 1 - y) * 0.6) < 0.018:
            g *= 1 - 0.4 * j
        gloss = 0.15
    elif material == GRASS:
        g = 0.72 + 0.3 * noise(u * 0.5, v * 0.5, 13) + 0.45 * (noise(u * 7, v * 7, 14) - 0.3) * _fade(fp, 7)
        g += 0.5 * (noise(u * 31, v * 31, 15) - 0.5) * _fade(fp, 31)
        a[0] *= 1 + 0.5 * (noise(u * 0.22, v * 0.22, 16) - 0.4)
    elif material == BRICK:
        h, x, y, j = _rows(u, v, 0.26, 0.085, fp, 22, 17)  # 11.8 rows a metre: fade before they alias
        g = 1 + 0.42 * j * h + 0.16 * (noise(u * 0.6, v * 0.6, 18) - 0.5)
        if x < 0.06 or y < 0.17:
            for c in range(3):
                a[c] += (0.42 - a[c]) * j * 0.65
    elif material in (PLASTER, CONCRETE):
        g = 1 + 0.14 * (noise(u * 0.5, v * 0.28, 19) - 0.5) + 0.1 * (noise(u * 3, v * 0.8, 23) - 0.5)
        g += 0.12 * (noise(u * 16, v * 16, 20) - 0.5) * _fade(fp, 16)
    elif material == TILES:
        h, x, y, j = _rows(u, v, 0.24, 0.32, fp, 4, 24)
        g = (
            1
            + j * (0.35 * h - 0.32 * _clip(1 - y * 4) - 0.15 * abs(x - 0.5))
            + 0.2 * (noise(u * 0.5, v * 0.5, 25) - 0.5)
        )
    elif material == LEAF:
        g = 0.8 + 0.7 * (noise(u * 6, v * 6, 26) - 0.3) * _fade(fp, 6)
        g += 0.5 * (noise(u * 19, v * 19, 27) - 0.5) * _fade(fp, 19)
    elif material in (BARK, WOOD):
        g = 0.82 + 0.5 * (noise(u * 22, v * 3, 28) - 0.4) * _fade(fp, 22)
    elif material == PAINT:
        gloss = 0.85
    elif material in (GLASS, WINDOW):
        gloss = 1.0
    elif material == METAL:
        gloss = 0.5
    elif material == SIGN:
        gloss = 0.2
    elif material == PLAIN:
        gloss = 0.06
    for c in range(3):
        a[c] *= max(g, 0.05)
    return gloss


@kernel
@no_type_check
def _glow(material, u, v, fp, instance, night, a):
    """Return how much a surface shines by itself; behind window panes stand curtains and things, and some are lit."""
    if material == HEADLIGHT:
        return 0.25 + 5 * night
    if material == LAMP:
        return 0.35 + 3.2 * night
    if material == TAILLIGHT:
        return 0.1 + 1.5 * night
    if material != WINDOW:
        return 0.0
    h = _hash(math.floor(u / 2.6), math.floor((v - 0.4) / 3.0), instance)
    blur = _fade(fp, 3)
    inside = 1 + (0.9 * _hash(math.floor(u / 0.42), math.floor(v / 0.5), 43) - 0.45) * blur
    for c in range(3):
        a[c] *= inside
    if night > 0 and h < 0.45:
        a[0], a[1], a[2] = 1.0, 0.68, 0.33
        height = v / 3.0 - math.floor(v / 3.0)
        e = (0.1 + 0.3 * h / 0.45) * inside * (0.45 + 0.9 * noise(u * 2.3, v * 1.2, 41))
        return e * (0.7 + 0.5 * height) * night
    if night == 0 and h > 0.5:
        a[0], a[1], a[2] = 0.32, 0.31, 0.29
    return 0.0


@kernel
@no_type_check
def _lamps(x, y, z, nx, ny, nz, soft, lamps, out):
    """Add up the light of lamps. Rows: position, direction, colour, cosine of the cone, reach squared."""
    out[0] = out[1] = out[2] = 0.0
    for i in range(lamps.shape[0]):
        lx, ly, lz = lamps[i, 0] - x, lamps[i, 1] - y, lamps[i, 2] - z
        d2 = lx * lx + ly * ly + lz * lz + 0.02
        if d2 > lamps[i, 10]:
            continue
        near = 1 / math.sqrt(d2)
        cosine = -(lx * lamps[i, 3] + ly * lamps[i, 4] + lz * lamps[i, 5]) * near
        beam = _clip((cosine - lamps[i, 9]) / (1.0001 - lamps[i, 9]) * 1.6)
        if beam <= 0:
            continue
        facing = (nx * lx + ny * ly + nz * lz) * near
        facing = _clip(0.3 + 0.7 * facing) if soft else max(facing, 0.0)
        w = beam * beam * facing / (d2 + 1.0) * (1 - d2 / lamps[i, 10])
        for c in range(3):
            out[c] += w * lamps[i, 6 + c]


@kernel
@no_type_check
def _occlusion(x, y, ground, origin, cell):
    """Return how much stands around a point of the ground, interpolated from a map."""
    gx, gy = (x - origin[0]) / cell - 0.5, (y - origin[1]) / cell - 0.5
    if not (0 <= gx < ground.shape[0] - 1 and 0 <= gy < ground.shape[1] - 1):
        return 0.0
    i, j = int(gx), int(gy)
    r, s = gx - i, gy - j
    low = ground[i, j] * (1 - r) + ground[i + 1, j] * r
    return low * (1 - s) + (ground[i, j + 1] * (1 - r) + ground[i + 1, j + 1] * r) * s


@kernel
@no_type_check
def shade(rays, t, face, corners, normals, lit, uv, color, material, instance, ground, origin, cell, anchor, light,
          lamps, focal, start, stop, out):  # fmt: skip
    """Put the linear colour of rays start..stop into out.

    rays: origin and direction; t: length along it, infinite for the sky; face, corners: triangle and barycentric
    coordinates there; lit: 1 where the sun reaches; uv, color, material, instance: tables of the triangles; ground: map
    of what stands on the ground, its lower corner and cell; anchor: where the origin of all coordinates lies in the
    world, for textures that must stay in place; focal: pixels.
    """
    a, sky, glare = np.empty(3), np.empty(3), np.empty(3)
    for q in range(start, stop):
        dx, dy, dz = rays[q, 3], rays[q, 4], rays[q, 5]
        scale = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        ex, ey, ez = dx * scale, dy * scale, dz * scale
        if not t[q] < 1e6:
            _sky(ex, ey, ez, light, True, sky)
            clear = math.exp(-light[HAZE] * 1.25 / (max(ez, 0.0) * 6 + 0.02))
            for c in range(3):
                out[q, c] = sky[c] * clear + light[HAZE_COLOR + c] * (1 - clear)
            continue
        k, distance = face[q], t[q] / scale
        x, y, z = rays[q, 0] + dx * t[q], rays[q, 1] + dy * t[q], rays[q, 2] + dz * t[q]
        nx, ny, nz = normals[q, 0], normals[q, 1], normals[q, 2]
        facing = nx * ex + ny * ey + nz * ez
        if facing > 0:
            nx, ny, nz, facing = -nx, -ny, -nz, -facing
        m = material[k]
        b1, b2 = corners[q, 0], corners[q, 1]
        u = uv[k, 0, 0] * (1 - b1 - b2) + uv[k, 1, 0] * b1 + uv[k, 2, 0] * b2
        v = uv[k, 0, 1] * (1 - b1 - b2) + uv[k, 1, 1] * b1 + uv[k, 2, 1] * b2
        fp = distance / focal / max(-facing, 0.12)
        for c in range(3):
            a[c] = color[k, c]
        gloss = _texture(m, u, v, fp, a)
        if m == LEAF:  # rough
            wx, wy = x + anchor[0], y + anchor[1]
            nx += 1.1 * (noise(wx * 5 + z, wy * 5, 31) - 0.5)
            ny += 1.1 * (noise(wy * 5 + z, z * 5, 32) - 0.5)
            nz += 1.1 * (noise(z * 5 + wx, wx * 5, 33) - 0.5) + 0.25
            i = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
            nx, ny, nz = nx * i, ny * i, nz * i
        if light[WET] > 0 and nz > 0.7 and (ASPHALT <= m <= GRASS or m == CONCRETE):
            for c in range(3):
                a[c] *= 1 - 0.45 * light[WET]
        if z < 0.3 and nz > 0.7:
            ambient = 1 - 0.72 * _occlusion(x, y, ground, origin, cell)
        else:
            ambient = (0.62 + 0.38 * _clip(z / 1.6)) * (0.55 if nz < -0.3 else 1.0)
        sun = nx * light[SUN] + ny * light[SUN + 1] + nz * light[SUN + 2]
        if m == LEAF:
            sun = _clip(0.3 + 0.62 * sun)
        elif m == GRASS:
            sun = _clip(0.2 + 0.8 * sun)
        sun = max(sun, 0.0) * lit[q]
        mirror = 0.0
        sky[:] = 0.0
        if gloss > 0.0:
            rx, ry, rz = ex - 2 * facing * nx, ey - 2 * facing * ny, ez - 2 * facing * nz
            graze = (1 + max(facing, -1.0)) ** 5
            mirror = gloss * (0.045 + 0.6 * graze) if gloss < 0.9 else 0.1 + 0.75 * graze
            _sky(rx, ry, max(rz, 0.0), light, gloss > 0.6, sky)
            dim = (0.25 + 0.75 * _clip(0.5 + 5 * rz)) * _clip(0.4 + 1.8 * rz)  # what stands around hides the low sky
            spot = max(rx * light[SUN] + ry * light[SUN + 1] + rz * light[SUN + 2], 0.0)
            spot = spot ** (60.0 if gloss > 0.6 else 14.0) * lit[q] * (0.8 if gloss > 0.6 else 0.15)
            for c in range(3):
                sky[c] = sky[c] * dim + light[SUN_COLOR + c] * spot
        emit = _glow(m, u, v, fp, instance[k], light[NIGHT], a)
        _lamps(x, y, z, nx, ny, nz, m == LEAF, lamps, glare)
        up = 0.5 + 0.5 * nz
        clear = math.exp(-light[HAZE] * distance)
        mirror_dim = 1.0 if nz <= 0.7 else ambient
        for c in range(3):
            around = (light[ZENITH + c] * 0.55 + light[HORIZON + c] * 0.45) * up + light[BOUNCE + c] * (1 - up)
            col = a[c] * (light[SUN_COLOR + c] * sun + around * ambient * light[AMBIENT] + glare[c])
            col = col * (1 - mirror) + sky[c] * mirror * mirror_dim + a[c] * emit
            out[q, c] = col * clear + light[HAZE_COLOR + c] * (1 - clear)


@kernel
@no_type_check
def sun_rays(rays, t, face, normals, material, sun, start, stop, out, needed):
    """Put rays towards the sun from hits start..stop into out; needed is 1 where the surface faces it."""
    for q in range(start, stop):
        needed[q] = 0
        if not t[q] < 150:
            continue
        facing = normals[q, 0] * rays[q, 3] + normals[q, 1] * rays[q, 4] + normals[q, 2] * rays[q, 5]
        off = -0.02 if facing > 0 else 0.02  # metres off the surface
        sunward = normals[q, 0] * sun[0] + normals[q, 1] * sun[1] + normals[q, 2] * sun[2]
        if material[face[q]] == LEAF or sunward * off > 0:
            needed[q] = 1
            for c in range(3):
                out[q, c] = rays[q, c] + rays[q, 3 + c] * t[q] + normals[q, c] * off + sun[c] * 0.01
                out[q, 3 + c] = sun[c]
