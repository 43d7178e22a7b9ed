"""One display name and one line style for each method, the same in every chart and table."""

from itertools import product
from typing import Literal, NamedTuple, Required, TypedDict

from physjax.stepping.methods import list_all_methods

PALETTE = (
    "#D55E00", "#E69F00", "#009E73", "#0072B2", "#56B4E9", "#CC79A7", "#8C6D31", "#6A51A3",
    "#44AA99", "#882255", "#999933", "#332288", "#AA4499", "#117733", "#661100", "#888888",
)  # fmt: skip
"""Okabe and Ito's colours, two more, and Tol's muted ones, which colour-blind readers distinguish as well as may be."""
MARKERS = "osD^vPXd<>hp8H1|"
Dashes = Literal["-", "--", "-.", ":"]
RIVAL_STYLES: dict[str, tuple[str, Dashes]] = {"diffrax Tsit5": ("0.55", "--"), "diffrax Dopri8": ("0.15", "-.")}
"""Grey and line of the solvers of other libraries."""
AS_GIVEN, PROJECTED = "as given", "projected"
"""Treatments of contacts: by the response that the scene gives them; resolved at the end of the step instead."""


class Variant(NamedTuple):
    """How a method ran: its name in the registry, the treatment of contacts, the float type, whether steps are adaptive."""

    method: str
    treatment: str = AS_GIVEN
    dtype: str = "float64"
    adaptive: bool = False

    @property
    def display_name(self) -> str:
        """What tables and charts call it: `adaptive rk4, projected, float32`."""
        words = [("adaptive " if self.adaptive else "") + self.method]
        words += [PROJECTED] if self.treatment == PROJECTED else []
        words += [self.dtype] if self.dtype == "float32" else []
        return ", ".join(words)


class LineStyle(TypedDict, total=False):
    """Keywords of a matplotlib line."""

    color: Required[str]
    marker: str
    linestyle: Dashes
    linewidth: float
    markersize: float
    markerfacecolor: str
    alpha: float


def style(
    method: str, *, treatment: str | None = None, dtype: str | None = None, adaptive: bool | None = None
) -> LineStyle:
    """Line style of a method: colour and marker by its place in the registry, dashed and hollow where it is projected.

    Adaptive methods are dash-dotted with stars, those in float32 pale, rivals grey. `method` may also be the display name
    of a variant, such as "rk4, projected"; the keywords come first.

    Example:
        >>> plot.style("verlet")["marker"] != plot.style("euler")["marker"]
        True
        >>> plot.style("rk4", treatment="projected") == plot.style("rk4, projected")
        True
    """
    named = _find_variant(method)
    variant = named._replace(
        treatment=named.treatment if treatment is None else treatment,
        dtype=named.dtype if dtype is None else dtype,
        adaptive=named.adaptive if adaptive is None else adaptive,
    )
    if variant.method not in list_all_methods():
        color, line = RIVAL_STYLES.get(method, ("0.4", ":"))
        return {"color": color, "marker": ".", "linestyle": line, "linewidth": 1.2, "markersize": 5}
    return _style_variant(variant)


def _find_variant(name: str) -> Variant:
    """The variant of a registered method with this display name; any other name is that of a rival."""
    variants = (
        Variant(*of) for of in product(list_all_methods(), (AS_GIVEN, PROJECTED), ("float64", "float32"), (False, True))
    )
    return next((variant for variant in variants if variant.display_name == name), Variant(name))


def _style_variant(variant: Variant) -> LineStyle:
    place = list(list_all_methods()).index(variant.method)
    line: LineStyle = {
        "color": PALETTE[place % len(PALETTE)],
        "marker": MARKERS[place % len(MARKERS)],
        "linestyle": "-",
        "linewidth": 1.5,
        "markersize": 4.5,
    }
    if variant.treatment == PROJECTED:
        line.update(linestyle="--", linewidth=1.1, markerfacecolor="white")
    if variant.adaptive:
        line.update(linestyle="-.", marker="*", markersize=7)
    if variant.dtype == "float32":
        line.update(alpha=0.45, linewidth=1.0, markersize=3)
    return line
