"""The bit stream of OctoMap's binary trees: two bytes an inner node, two bits a child, depth first."""

from typing import no_type_check

from openvocab_occ._jit import kernel

DEPTH = 16


@kernel
@no_type_check
def read_tree(data, out_leaves, out_counts):
    """Write x, y, z (lowest key), depth and state (1 free, 2 occupied) of each leaf.

    Counts are leaves, nodes, bytes used. Returns False when the stream ends too soon or a node lies too deep.
    """
    stack_x, stack_y, stack_z, stack_d = [0], [0], [0], [0]
    at, leaves, nodes = 0, 0, 1
    while len(stack_x):
        x, y, z, d = stack_x.pop(), stack_y.pop(), stack_z.pop(), stack_d.pop()
        if at + 2 > len(data) or d >= DEPTH:
            return False
        bits = data[at] | (data[at + 1] << 8)
        at += 2
        half = 1 << (DEPTH - d - 1)
        for child in range(7, -1, -1):  # pushed last to first, so that the first is read next
            state = bits >> (2 * child) & 3
            if state == 3:
                stack_x.append(x + half * (child & 1))
                stack_y.append(y + half * (child >> 1 & 1))
                stack_z.append(z + half * (child >> 2))
                stack_d.append(d + 1)
        for child in range(8):
            state = bits >> (2 * child) & 3
            if state:
                nodes += 1
            if state == 1 or state == 2:
                if leaves == len(out_leaves):
                    return False
                out_leaves[leaves, 0] = x + half * (child & 1)
                out_leaves[leaves, 1] = y + half * (child >> 1 & 1)
                out_leaves[leaves, 2] = z + half * (child >> 2)
                out_leaves[leaves, 3] = d + 1
                out_leaves[leaves, 4] = state  # bit 0 alone is free, bit 1 alone occupied: fixed by the caller
                leaves += 1
    out_counts[0], out_counts[1], out_counts[2] = leaves, nodes, at
    return True


@kernel
@no_type_check
def write_tree(codes, states, out):
    """Write the tree of sorted Morton codes of the deepest leaves, three bits a level; return nodes and bytes.

    Works through ranges of codes that share a node, depth first.
    """
    first, last, depth = [0], [len(codes)], [0]
    at, nodes = 0, 1
    while len(first):
        a, b, d = first.pop(), last.pop(), depth.pop()
        shift = 3 * (DEPTH - d - 1)
        bits = 0
        edge = a
        starts, stops = [0] * 8, [0] * 8
        for child in range(8):
            starts[child] = edge
            while edge < b and (codes[edge] >> shift & 7) == child:
                edge += 1
            stops[child] = edge
            if edge > starts[child]:
                nodes += 1
                bits |= (3 if d < DEPTH - 1 else states[starts[child]]) << (2 * child)
        out[at], out[at + 1] = bits & 255, bits >> 8
        at += 2
        if d < DEPTH - 1:
            for child in range(7, -1, -1):
                if stops[child] > starts[child]:
                    first.append(starts[child])
                    last.append(stops[child])
                    depth.append(d + 1)
    return nodes, at
