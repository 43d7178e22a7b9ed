"""The old name of `physjax.physics.rigid.inertia`."""

from physjax.physics.rigid.inertia import *  # noqa: F403
from physjax.physics.rigid.inertia import __all__ as __all__


def __dir__() -> list[str]:
    return __all__
