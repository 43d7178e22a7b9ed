"""All steps between two frames as one kernel of a GPU, from the same step that any other run takes.

Lanes that do not see each other need nothing from memory between two steps. What a step does with one lane is traced
once, as a program of small arrays, and written out number by number; a kernel runs it on a block of lanes, each a thread
that keeps its numbers in registers. Branches and loops end when all lanes of the block are done with them, and nobody
asks the host.

The kernel is for runs by themselves. Derivatives, and runs that a transformation is around, take the plain loop.
"""

from physjax.kernels.flights import LaneKernel, Layout

__all__ = ["LaneKernel", "Layout"]
