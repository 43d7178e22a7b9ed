"""Joints that leave one way to move, in which they may have limits and a motor: what hinges and sliders have in common."""

from abc import abstractmethod
from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from physjax.checks import OptionalNumbers, as_real_quantity, concrete_or_none, demand_all, quantity
from physjax.constraints.ranges import Bounds, Rows, spread_bounds
from physjax.physics.rigid.body_joints import BodyJoints

Limits = tuple[ArrayLike | Sequence | None, ArrayLike | Sequence | None]
"""The least and the greatest value; None: no limit on that side."""


class DrivenJoints(BodyJoints):
    """Joints with one way to move, by an angle [rad] or a travel [m], which is their last row where it is bounded.

    It is kept between `low` and `high`, and driven at the speed `motor`, or to `servo` as e^(-t/`response_time`) says, by at
    most `cap` [N m] or [N].
    """

    low: OptionalNumbers = quantity("lower limits", "rad or m", per="joint", default=None, kw_only=True)
    high: OptionalNumbers = quantity("upper limits", "rad or m", per="joint", default=None, kw_only=True)
    motor: OptionalNumbers = quantity("motor", "rad/s or m/s", per="joint", default=None, kw_only=True)
    servo: OptionalNumbers = quantity("servo", "rad or m", per="joint", default=None, kw_only=True)
    response_time: OptionalNumbers = quantity("response_time", "s", per="joint", above=0, default=None, kw_only=True)

    def set_drive(
        self,
        unit: str,
        limits: Limits | None,
        motor: ArrayLike | Sequence | None,
        servo: ArrayLike | Sequence | None,
        response_time: ArrayLike | Sequence | None,
        cap: tuple[str, str, ArrayLike | Sequence | None],
    ) -> Array | None:
        """Check and set limits and motor, for constructors; and return the `cap`, given with its name and unit."""
        read = lambda name, value, **least: None if value is None else as_real_quantity(name, value, **least)  # noqa: E731
        kind, (what, newtons, most) = type(self).__name__, cap
        low, high = (None, None) if limits is None else limits
        self.low, self.high = read(f"lower limits [{unit}]", low), read(f"upper limits [{unit}]", high)
        self.motor, self.servo = read(f"motor [{unit}/s]", motor), read(f"servo [{unit}]", servo)
        self.response_time = read("response_time [s]", response_time, above=0.0)
        if self.low is not None and self.high is not None:
            width = concrete_or_none(jnp.asarray(self.high) - jnp.asarray(self.low))
            if width is not None:
                demand_all(f"{kind}: upper minus lower limits [{unit}]", width, width > 0, "numbers > 0")
        if motor is not None and servo is not None:
            raise ValueError(f"{kind}: got a motor and a servo, expected a speed or a target, not both.")
        if (motor is None and servo is None) != (most is None):
            raise ValueError(
                f"{kind}: got motor={motor}, servo={servo} and {what}={most}, expected a motor or a servo together with the "
                f"most that it exerts, {what} [{newtons}]."
            )
        if (servo is None) != (response_time is None):
            raise ValueError(
                f"{kind}: got servo={servo} and response_time={response_time}, expected both: the time [s] in which a servo "
                "comes nearer to its target by e."
            )
        if self.bounded and self.order != 2:
            raise ValueError(f"{kind}: got order={self.order}, expected 2 for joints with limits or motors.")
        return read(f"{what} [{newtons}]", most, at_least=0.0)

    @property
    def bounded(self) -> bool:
        """Whether they have limits or a motor."""
        return any(number is not None for number in (self.low, self.high, self.motor, self.servo))

    @property
    def rows(self) -> int:
        """Those that are always held, and one if it is bounded."""
        return self.held_rows + self.bounded

    @property
    @abstractmethod
    def cap(self) -> Array | None:
        """The most that a motor exerts [N m] or [N]; None without one."""

    @property
    @abstractmethod
    def held_rows(self) -> int:
        """How many rows are always held."""

    def find_bounds(self, like: Rows) -> Bounds:
        """The limits and the drive of the last row."""
        if not self.bounded:
            return Bounds.hold(like)
        shape, held = like.shape[1:], like[:-1]
        gain = None if self.response_time is None else 1 / self.response_time

        def extend(number: Array | None, absent: float) -> Rows:
            row = jnp.full(shape, absent, like.dtype) if number is None else spread_bounds(number, shape)
            return jnp.concatenate([held, row[None].astype(like.dtype)])

        numbers = (self.low, self.high, self.motor, self.servo, gain, self.cap)
        return Bounds(*(map(extend, numbers, (-jnp.inf, jnp.inf, 0.0, 0.0, 0.0, 0.0))))


__all__ = ["DrivenJoints", "Limits"]
