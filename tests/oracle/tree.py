"""A tree of components: the grouping that explains most wins."""

from __future__ import annotations

from typing import List, Optional, Sequence, Tuple

from oracle.levels import parents


def winners(nodes: Sequence[Sequence[int]], worths: Sequence[Sequence[int]]) -> List[Optional[Tuple[int, int]]]:
    """The component whose motion each pixel takes.

    Args:
        nodes: per level, coarse to fine: component of each pixel, -1 = none.
        worths: per level: worth of each component, at least 0.

    Returns:
        Of each pixel (level, component): the coarsest of its components that is worth more than its parts together;
        if there is none, its finest one; None if it has no finest one.

    Convention: the parts of a component are the components of the next finer level whose parent it is. A group of parts
        is worth what they sum up to, or what their component is worth if that is more.
    """
    finest = len(nodes) - 1
    parent = [parents(node, above) for node, above in zip(nodes[1:], nodes)]  # of the components of level 1, 2, ...

    def sum_of_parts(level: int, component: int) -> int:
        if level == finest:
            return 0
        parts = [part for part, owner in enumerate(parent[level]) if owner == component]
        return sum(max(worths[level + 1][part], sum_of_parts(level + 1, part)) for part in parts)

    result: List[Optional[Tuple[int, int]]] = []
    for components in zip(*nodes):
        winner = None if components[finest] < 0 else (finest, components[finest])
        for level in reversed(range(finest)):
            component = components[level]
            if component >= 0 and worths[level][component] > sum_of_parts(level, component):
                winner = level, component
        result.append(winner)
    return result
