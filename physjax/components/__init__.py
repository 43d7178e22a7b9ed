"""The vectors of a step split into components inside a compiled loop, without touching what computes them.

On a GPU an operation on `(lanes, dim)` arrays gives every component a thread of its own, and where a later operation
needs the length of the vector each of these computes all of it again: a step of rk4 three times in space. With one array
for each component a lane is one thread. Physics is written with vectors; here its program (a jaxpr) is traced once and
computed on components.

Which arrays are vectors is said by those who know: of a scene the arrays of its state and the numbers declared as
vectors. It is followed from there through every operation, and never guessed from a length; an operation without a rule
sees whole arrays, which is always right.
"""

from physjax.components.interpreter import compute_by_components
from physjax.components.values import forget_wholes, join_vectors, split_vectors

__all__ = ["compute_by_components", "forget_wholes", "join_vectors", "split_vectors"]
