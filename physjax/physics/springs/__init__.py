"""Springs between nodes, of which ropes, cloth, jelly and bridges are built, and rods and ropes of exact length.

`Springs` with `tension_only=True` are ropes that go slack. `lattices` builds a rope, cloth, jelly, a bridge, or a network from
a mesh file: OBJ and PLY are read strictly, and what is not understood is refused (STL and GLB need `physjax[mesh]`).
Triangles are connected by the vertices that they share; vertices at the same place are welded, with a warning.

# Known limitations

- Springs break at the end of a step, so a scene that breaks is first order under every method.
- Springs yield within a step, with their set kept at its end: second order, and under `implicit_euler` first.
- `implicit_euler` converges slowly with wind on faces, and in float32 only to about 1e-4 of a step's kick.
- `stability.limit` takes seconds for thousands of nodes.
- Reverse mode through springs costs ten to twenty forward runs.
"""

from physjax.name_hints import hint_at_names
from physjax.physics.springs.rods import Rods, Ropes
from physjax.physics.springs.springs import Springs

__all__ = ["Rods", "Ropes", "Springs"]


def __dir__() -> list[str]:
    return __all__


hint_at_names(__name__)
