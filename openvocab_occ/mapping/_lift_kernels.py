"""The lift's sparse matrix, counted per square of the feature map, and its product with the cells.

A *square* lies between four neighbouring cell centres; all pixels in it mix the same four cells. An *entry* is what the
pixels of one square say about one row: four weights, pixels, colours, the pixel box. Entries are many times fewer than
pixels, and the product takes four cells an entry.
"""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel

FIELDS = 11
"""An entry's fields: 4 weights, pixels, 3 colours, 3 of the normal."""


@kernel
@no_type_check
def _direction(v, u, K, rays):
    """Return x and y of the ray (x, y, 1) of a pixel: from `rays`, or where that is empty by a pinhole's K."""
    if rays.shape[0] > 0:
        return rays[v, u, 0], rays[v, u, 1]
    y = (v - K[1, 2]) / K[1, 1]
    return (u - K[0, 2] - K[0, 1] * y) / K[0, 0], y


@kernel
@no_type_check
def _slope(before, here, after):
    """Return the difference of inverse depth to the neighbour that is nearer to it, seen forwards, and the bend.

    On a plane inverse depth is linear over the image, so both differences agree and the bend is 0. Neighbours
    without depth (0) do not count.
    """
    if before > 0.0 and after > 0.0:
        back, forth = here - before, after - here
        return (back if abs(back) < abs(forth) else forth), abs(forth - back) / here
    if before > 0.0:
        return here - before, 0.0
    return (after - here if after > 0.0 else 0.0), 0.0


@kernel
@no_type_check
def _look(v, u, inverse, K, rays, options):
    """Return a pixel's weight and the normal of what it sees, in the camera's frame, towards the camera.

    With 1 / z = a x + b y + c over the rays (x, y, 1), (a, b, c) is along the normal. `options` as in `PixelWeights`:
    range, grazing, border in pixels, bend, and the reach of the differences in pixels; 0 for not used.
    """
    h, w = inverse.shape
    weight, here = 1.0, inverse[v, u]
    if options[2] > 0.0:
        weight *= min(1.0, min(min(u + 0.5, w - 0.5 - u), min(v + 0.5, h - 0.5 - v)) / options[2])
    if not here > 0.0:
        return weight, 0.0, 0.0, 0.0
    if options[0] > 0.0:
        weight /= 1.0 + 1.0 / (here * options[0]) ** 2
    reach = int(options[4])
    left = inverse[v, u - reach] if u >= reach else 0.0
    right = inverse[v, u + reach] if u + reach < w else 0.0
    above = inverse[v - reach, u] if v >= reach else 0.0
    below = inverse[v + reach, u] if v + reach < h else 0.0
    du, bend_u = _slope(left, here, right)
    dv, bend_v = _slope(above, here, below)
    if options[3] > 0.0:
        weight /= 1.0 + (max(bend_u, bend_v) / options[3]) ** 2
    x, y = _direction(v, u, K, rays)
    a, b = du * K[0, 0] / reach, dv * K[1, 1] / reach
    c = here - a * x - b * y
    length = np.sqrt(a * a + b * b + c * c)
    if not length > 0.0:
        return weight, 0.0, 0.0, 0.0
    if options[1] > 0.0:  # here = (a, b, c) . (x, y, 1), so this is the cosine
        weight *= max(options[1], here / (length * np.sqrt(x * x + y * y + 1.0)))
    return weight, -a / length, -b / length, -c / length


@kernel
@no_type_check
def count_entries(
    rows, x, y, columns, bands, start, stop, inverse, K, rays, options, image, stamp, slot, row, square, box, out
):
    """Write the entries of bands start..stop and return how many there are.

    `columns` and `bands` hold where each run of u, of v, with the same left, upper, cell begins. `stamp` begins below
    every square's number. Pixels that weigh nothing still count as pixels.
    """
    n = 0
    shaped, colored = inverse.shape[0] > 0, image.shape[0] > 0
    for b in range(start, stop):
        for c in range(len(columns) - 1):
            number = b * (len(columns) - 1) + c
            for v in range(bands[b], bands[b + 1]):
                fy = y[v]
                for u in range(columns[c], columns[c + 1]):
                    r = rows[v, u]
                    if r < 0:
                        continue
                    if stamp[r] != number:
                        stamp[r], slot[r] = number, n
                        row[n], square[n, 0], square[n, 1] = r, b, c
                        box[n, 0], box[n, 1], box[n, 2], box[n, 3] = u, v, u, v
                        out[n, :] = 0.0
                        n += 1
                    e = slot[r]
                    weight, fx = 1.0, x[u]
                    if shaped:
                        weight, nx, ny, nz = _look(v, u, inverse, K, rays, options)
                        out[e, 8] += weight * nx
                        out[e, 9] += weight * ny
                        out[e, 10] += weight * nz
                    out[e, 0] += weight * (1.0 - fy) * (1.0 - fx)
                    out[e, 1] += weight * (1.0 - fy) * fx
                    out[e, 2] += weight * fy * (1.0 - fx)
                    out[e, 3] += weight * fy * fx
                    out[e, 4] += 1.0
                    if colored:
                        out[e, 5] += weight * image[v, u, 0]
                        out[e, 6] += weight * image[v, u, 1]
                        out[e, 7] += weight * image[v, u, 2]
                    box[e, 0], box[e, 2] = min(box[e, 0], u), max(box[e, 2], u)
                    box[e, 3] = v
    return n


@kernel
@no_type_check
def multiply(first, entry, corner, width, height, weights, cells, start, stop, out):
    """Add to rows start..stop of `out` the four cells of each of their entries, in order of the entries.

    `corner` is the flat index of an entry's upper left cell; cells beyond the map are the outermost.
    """
    for r in range(start, stop):
        for k in range(first[r], first[r + 1]):
            e = entry[k]
            a = corner[e]
            right = 1 if a % width < width - 1 else 0
            down = width if a // width < height - 1 else 0
            w0, w1 = np.float32(weights[e, 0]), np.float32(weights[e, 1])
            w2, w3 = np.float32(weights[e, 2]), np.float32(weights[e, 3])
            upper, lower = cells[a], cells[a + down]
            upper_right, lower_right = cells[a + right], cells[a + down + right]
            for c in range(cells.shape[1]):
                out[r, c] += w0 * upper[c] + w1 * upper_right[c] + w2 * lower[c] + w3 * lower_right[c]


@kernel
@no_type_check
def add_fields(row, box, fields, out_weight, out_pixels, out_color, out_normal, out_box):
    """Add up the entries of each row, in order; boxes grow to hold all pixels."""
    for e in range(len(row)):
        r = row[e]
        out_weight[r] += fields[e, 0] + fields[e, 1] + fields[e, 2] + fields[e, 3]
        if out_pixels[r] == 0:
            out_box[r] = box[e]
        else:
            out_box[r, 0], out_box[r, 1] = min(out_box[r, 0], box[e, 0]), min(out_box[r, 1], box[e, 1])
            out_box[r, 2], out_box[r, 3] = max(out_box[r, 2], box[e, 2]), max(out_box[r, 3], box[e, 3])
        out_pixels[r] += int(fields[e, 4])
        for c in range(3):
            out_color[r, c] += fields[e, 5 + c]
            out_normal[r, c] += fields[e, 8 + c]
