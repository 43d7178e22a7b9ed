"""One line style for each method, the same in every chart."""

from typing import Any

from physjax.stepping.methods import METHODS

PALETTE = ("#D55E00", "#E69F00", "#009E73", "#0072B2", "#56B4E9", "#CC79A7", "#8C6D31", "#6A51A3")
"""Okabe and Ito's colours, told apart by the colour-blind too; two more for methods to come."""
MARKERS = "osD^vPX*"
RIVAL_STYLES = {"diffrax Tsit5": ("0.55", "--"), "diffrax Dopri8": ("0.15", "-.")}
PROJECTED_SUFFIX = ", projected"
"""What is added to a method's name where its touches are answered at the end of the step."""
FLOAT32_SUFFIX = ", float32"
"""What is added where it ran in float32."""
ADAPTIVE_PREFIX = "adaptive "
"""What stands before the name of a method that is subdivided."""


def style(method: str) -> dict[str, Any]:
    """Line style of a method: colour and marker by its place in the registry, dashed and hollow where it is projected.

    Subdivided methods are dash-dotted with stars, those in float32 pale, rivals grey.

    Example:
        >>> plot.style("verlet")["marker"] != plot.style("euler")["marker"]
        True
    """
    narrow = method.endswith(FLOAT32_SUFFIX)
    plain = method.removesuffix(FLOAT32_SUFFIX)
    name = plain.removesuffix(PROJECTED_SUFFIX).removeprefix(ADAPTIVE_PREFIX)
    if name in METHODS:
        place = list(METHODS).index(name)
        line = {
            "color": PALETTE[place % len(PALETTE)],
            "marker": MARKERS[place % len(MARKERS)],
            "linestyle": "-",
            "linewidth": 1.5,
            "markersize": 4.5,
        }
        if plain.endswith(PROJECTED_SUFFIX):
            line |= {"linestyle": "--", "linewidth": 1.1, "markerfacecolor": "white"}
        if plain.startswith(ADAPTIVE_PREFIX):
            line |= {"linestyle": "-.", "marker": "*", "markersize": 7}
        return line | {"alpha": 0.45, "linewidth": 1.0, "markersize": 3} if narrow else line
    color, line = RIVAL_STYLES.get(method, ("0.4", ":"))
    return {"color": color, "marker": ".", "linestyle": line, "linewidth": 1.2, "markersize": 5}
