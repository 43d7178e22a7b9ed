"""What a GPU would suffer from in a compiled run, counted in its lowered text: no GPU is needed for it."""

import functools
import math
import re
from collections import Counter
from typing import NamedTuple


class LoopCounts(NamedTuple):
    """What one turn of the loops of a run holds, branches and calls included.

    `on_vectors`: operations on `(lanes, dim)` arrays, where each component is a thread of its own. `branches` and
    `loops`: conditionals and loops in it, each of which asks the host.
    """

    on_vectors: int
    branches: int
    loops: int


def holds_vectors(line, lanes):
    """Whether an operation has an operand or a result that is vectors of so many lanes or more."""
    shapes = (tuple(map(int, axes.split("x"))) for axes in re.findall(r"tensor<(\d+(?:x\d+)+)xf\d\d>", line))
    return any(2 <= dim <= 4 and math.prod(front) >= lanes for *front, dim in shapes)


def count_in_loops(lowered, lanes):
    """The counts of a lowered run of so many lanes; a function counts as often as it is called.

    Vectors are arrays of floats whose last axis has two to four entries, those of flagged lanes, computed in groups of
    one in 32, as well. The loop over frames holds all others: it is not counted.
    """
    outside, inside, calls, name = {}, {}, {}, None
    depth, bodies = 0, []  # of braces, and those at which the bodies of loops begin
    for line in lowered.as_text().splitlines():
        head = re.match(r"\s*func\.func (?:public|private) @([\w.$-]+)\(", line)
        if head:
            name, depth, bodies = head[1], 0, []
            outside[name], inside[name], calls[name] = Counter(), Counter(), []
        elif name is not None:
            count = inside[name] if bodies else outside[name]
            count["on_vectors"] += (
                "stablehlo." in line and "stablehlo.while" not in line and holds_vectors(line, lanes // 32)
            )
            count["branches"] += len(re.findall(r"stablehlo\.(?:case|if)\b", line))
            count["loops"] += "stablehlo.while" in line
            calls[name] += [(callee, bool(bodies)) for callee in re.findall(r"(?<!custom_)\bcall @([\w.$-]+)\(", line)]
        # signatures of functions and attributes open and close in one line
        if re.search(r"} do {", line):
            bodies.append(depth)
        depth += line.count("{") - line.count("}")
        if bodies and depth < bodies[-1]:
            bodies.pop()

    @functools.cache
    def total(function, within):
        found = inside[function] + (outside[function] if within else Counter())
        for callee, in_loop in calls[function]:
            found = found + total(callee, within or in_loop)
        return found

    found = total("main", False)
    return LoopCounts(*(found[name] for name in LoopCounts._fields))
