"""The gallery of scenes: each is one decorated function with its own truths; every file in this folder is imported.

To add a scene, write a function that returns a `Problem` under `@scene`, in a file of this folder, old or new, and let
`catalogue.write_table()` note what `physjax scenes` says of it. The problem carries what is known about the scene: a closed form,
conserved quantities, or statements that must hold.

Example:
    >>> from physjax.study.problem import Problem
    >>> def thrown_up(speed=10.0, g=9.8):  # under @scenes.scene it is in the gallery
    ...     ball = Particles(jnp.zeros(1), jnp.full(1, speed))
    ...     up = Scene(ball, forces=(forces.Gravity(g, up=0),))
    ...     column = lambda numbers: numbers[:, None]
    ...     exact = lambda t: Particles(column(speed * t - g * t**2 / 2), column(speed - g * t))
    ...     return Problem(up, duration=2.0, exact=exact, conserved=(energy.ENERGY,))
    >>> print(thrown_up().exact(jnp.array([1.0])).position)
    [[5.1]]
"""

from importlib import import_module
from pkgutil import iter_modules

from physjax.name_hints import hint_at_names
from physjax.scenes.registry import FAILURES, SCENES, failure, scene, title

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = ["FAILURES", "SCENES", "failure", "scene", "title"]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
