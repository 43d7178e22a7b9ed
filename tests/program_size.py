"""How large a lowered program is, with every call inlined: its operations are what takes time to compile, its bytes to run."""

import functools
import re
from collections import Counter

BYTES = {"f64": 8, "f32": 4, "i64": 8, "ui64": 8, "i32": 4, "ui32": 4, "i8": 1, "ui8": 1, "i1": 1}
"""Of a number of a type."""
COUNTED = ("operations", "bytes", "concatenates", "scatters")


def count_program(lowered):
    """Operations, bytes of all that they return, concatenates and scatters; those of a function as often as it is called.

    A `jit` within another is lowered as a function; the compiler inlines it, wherever it is called from. The body of a loop
    counts once.
    """
    own, calls, name = {}, {}, None
    for line in lowered.as_text().splitlines():
        head = re.match(r"\s*func\.func (?:public|private) @([\w.$-]+)\(", line)
        if head:
            name = head.group(1)
            own[name], calls[name] = Counter(), []
        elif name is not None:
            own[name].update(_count_line(line))
            calls[name] += re.findall(r"(?<!custom_)\bcall @([\w.$-]+)\(", line)

    @functools.cache
    def total(function):
        return sum((total(callee) for callee in calls[function]), own[function])

    found = total("main")
    return {what: found[what] for what in COUNTED}


def count_operations(lowered):
    """The operations of a lowered program."""
    return count_program(lowered)["operations"]


def _count_line(line):
    operations = len(re.findall(r"\bstablehlo\.\w+", line))
    returned = line.rpartition("->")[2] if "->" in line else line.rpartition(" : ")[2]
    counts = {"operations": operations, "bytes": _count_bytes(returned) if operations else 0}
    # what follows a # is an attribute of an operation
    found = {f"{kind}s": len(re.findall(rf"(?<!#)stablehlo\.{kind}\b", line)) for kind in ("concatenate", "scatter")}
    return counts | found


def _count_bytes(types):
    sizes = 0
    for axes, kind in re.findall(r"tensor<((?:\d+x)*)(\w+)>", types):
        sizes += BYTES.get(kind, 0) * functools.reduce(lambda a, b: a * int(b), axes.split("x")[:-1], 1)
    return sizes
