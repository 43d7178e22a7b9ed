"""Drag by a table of the drag coefficient over the Mach number, as ballisticians measure it, with the G1 projectile's."""

import math

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from physjax.checks import NestedArrayLike, Numbers, OptionalNumbers, concrete_or_none, demand_all, quantity
from physjax.particles import Particles
from physjax.parts import Force
from physjax.vectors import broadcast_vector, norm, scale

G1_DRAG = (
    (0, 0.2629),
    (0.05, 0.2558),
    (0.1, 0.2487),
    (0.15, 0.2413),
    (0.2, 0.2344),
    (0.25, 0.2278),
    (0.3, 0.2214),
    (0.35, 0.2155),
    (0.4, 0.2104),
    (0.45, 0.2061),
    (0.5, 0.2032),
    (0.55, 0.202),
    (0.6, 0.2034),
    (0.7, 0.2165),
    (0.725, 0.223),
    (0.75, 0.2313),
    (0.775, 0.2417),
    (0.8, 0.2546),
    (0.825, 0.2706),
    (0.85, 0.2901),
    (0.875, 0.3136),
    (0.9, 0.3415),
    (0.925, 0.3734),
    (0.95, 0.4084),
    (0.975, 0.4448),
    (1, 0.4805),
    (1.025, 0.5136),
    (1.05, 0.5427),
    (1.075, 0.5677),
    (1.1, 0.5883),
    (1.125, 0.6053),
    (1.15, 0.6191),
    (1.2, 0.6393),
    (1.25, 0.6518),
    (1.3, 0.6589),
    (1.35, 0.6621),
    (1.4, 0.6625),
    (1.45, 0.6607),
    (1.5, 0.6573),
    (1.55, 0.6528),
    (1.6, 0.6474),
    (1.65, 0.6413),
    (1.7, 0.6347),
    (1.75, 0.628),
    (1.8, 0.621),
    (1.85, 0.6141),
    (1.9, 0.6072),
    (1.95, 0.6003),
    (2, 0.5934),
    (2.05, 0.5867),
    (2.1, 0.5804),
    (2.15, 0.5743),
    (2.2, 0.5685),
    (2.25, 0.563),
    (2.3, 0.5577),
    (2.35, 0.5527),
    (2.4, 0.5481),
    (2.45, 0.5438),
    (2.5, 0.5397),
    (2.6, 0.5325),
    (2.7, 0.5264),
    (2.8, 0.5211),
)
"""Mach number and drag coefficient of the standard projectile G1, flat at its base, up to Mach 2.8."""


class TabulatedDrag(Force):
    """Drag whose coefficient depends on the speed: F = -½ρC_d(M)A |v| v, with the Mach number M = |v|/c, v relative to the wind.

    `mach` rises, `coefficient` has an entry for each of its; between them C_d is linear, beyond the ends it stays. Area A
    [m²], density ρ [kg/m³], speed of sound c [m/s]. A step across a knot of the table is of order 2 there. Raises ValueError
    for tables that do not fit or do not rise.

    Example:
        >>> drag = forces.TabulatedDrag([0.0, 1.0], [0.5, 1.5], area=0.2, density=2.0, speed_of_sound=10.0)
        >>> print(drag(0.0, ball, shot.mass))  # Mach 0.5, C_d = 1
        [-3. -4.]
    """

    mach: Numbers = quantity("Mach number", "1", per=None, at_least=0)
    coefficient: Numbers = quantity("drag coefficient C_d", "1", per=None, at_least=0)
    area: Numbers = quantity("area", "m²", at_least=0, kw_only=True)
    density: Numbers = quantity("density of the air", "kg/m³", at_least=0, default=1.225, kw_only=True)
    speed_of_sound: Numbers = quantity("speed of sound", "m/s", above=0, default=340.29, kw_only=True)
    wind: OptionalNumbers = quantity("wind", "m/s", kind="vector", default=None, kw_only=True)

    def __check_init__(self):
        if self.mach.ndim != 1 or self.mach.shape != self.coefficient.shape:
            raise ValueError(
                f"TabulatedDrag: got mach of shape {self.mach.shape} and coefficient of shape {self.coefficient.shape}, "
                "expected two tables of equal length, (knots,)."
            )
        if (mach := concrete_or_none(self.mach)) is not None:
            demand_all("Mach number [1]", mach[1:], mach[1:] > mach[:-1], "numbers that rise")

    @classmethod
    def g1(
        cls, ballistic_coefficient: ArrayLike, mass: ArrayLike, wind: NestedArrayLike | None = None
    ) -> "TabulatedDrag":
        """A bullet of that mass [kg] and G1 ballistic coefficient m/d² [kg/m²]; 1 lb/in² is 703.07 kg/m²."""
        area = math.pi / 4 * jnp.asarray(mass) / jnp.asarray(ballistic_coefficient)
        mach, coefficient = zip(*G1_DRAG, strict=True)
        return cls(mach, coefficient, area=area, wind=wind)

    def __call__(self, t: ArrayLike, state: Particles, mass: Float[Array, "..."]) -> Float[Array, "*lanes dim"]:
        """-½ρC_d(M)A |v - wind| (v - wind) [N]."""
        v = state.velocity if self.wind is None else state.velocity - broadcast_vector(self.wind, state.velocity)
        speed = norm(v)
        coefficient = jnp.interp(speed / self.speed_of_sound, self.mach, self.coefficient)
        return scale(-0.5 * self.density * coefficient * self.area * speed, v)


__all__ = ["TabulatedDrag"]


def __dir__() -> list[str]:
    return __all__
