"""How large a compiled program is: its operations, with every call inlined, which is what takes time to compile."""

import functools
import re


def count_operations(lowered):
    """The operations of a lowered program, those of a function as often as it is called.

    A `jit` within another is lowered as a function; the compiler inlines it, wherever it is called from.
    """
    own, calls, name = {}, {}, None
    for line in lowered.as_text().splitlines():
        head = re.match(r"\s*func\.func (?:public|private) @([\w.$-]+)\(", line)
        if head:
            name = head.group(1)
            own[name], calls[name] = 0, []
        elif name is not None:
            own[name] += len(re.findall(r"\bstablehlo\.\w+", line))
            calls[name] += re.findall(r"(?<!custom_)\bcall @([\w.$-]+)\(", line)

    @functools.cache
    def total(function):
        return own[function] + sum(total(callee) for callee in calls[function])

    return total("main")
