"""The predicate of Felzenszwalb and Huttenlocher (2004), with sets and without union-find."""

import numpy as np


def merge_edges(pairs: np.ndarray, weights: np.ndarray, num_nodes: int, scale: float, least: int) -> np.ndarray:
    """Return the smallest node of each node's component. Equal weights are taken in the order of the edges."""
    sets = [{node} for node in range(num_nodes)]
    edges = sorted(range(len(pairs)), key=lambda e: (weights[e], e))

    def home(node: int | np.integer) -> set[int]:
        return next(s for s in sets if int(node) in s)

    def heaviest(nodes: set[int]) -> float:
        """Internal difference: the heaviest edge among those accepted inside a component."""
        return max((float(weights[e]) for e in accepted if pairs[e][0] in nodes), default=0.0)

    accepted: list[int] = []
    for small in (False, True):
        for e in edges:
            a, b = home(pairs[e][0]), home(pairs[e][1])
            bound = min(heaviest(s) + scale / len(s) for s in (a, b))
            wanted = min(len(a), len(b)) < least if small else weights[e] <= bound
            if a is not b and wanted:
                accepted.append(e)
                sets = [s for s in sets if s is not a and s is not b] + [a | b]
    return np.array([min(home(node)) for node in range(num_nodes)], dtype=np.int64)
