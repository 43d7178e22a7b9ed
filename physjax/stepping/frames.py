"""How the steps between two frames are taken: step by step, in blocks of lanes, or all in one kernel.

Each way carries the state in a form of its own and brings it back: the physics is the same step.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from physjax.backend import choose_unrolled_steps, splits_vectors
from physjax.components import compute_by_components, forget_wholes, join_vectors, split_vectors
from physjax.loops import repeat_steps
from physjax.programs import count_operations, holds_loops
from physjax.scene import Scene
from physjax.stepping.blocks import Blocks

if TYPE_CHECKING:
    import physjax.kernels


class Moving(NamedTuple):
    """What a step changes: arrays of the scene, and the memory of a method that has one."""

    arrays: PyTree
    memory: PyTree


Step = Callable[[Array, Moving, PyTree, Array], Moving]
"""A step of a scene: `(number, moving, still, dt) -> moving`; `still` are the arrays of the scene that it does not change."""


@runtime_checkable
class Steps(Protocol):
    """A way to take steps."""

    def start(self, moving: PyTree) -> Any:
        """What is carried from frame to frame."""
        ...

    def advance(self, carried: Any, first: Array, count: int) -> Any:
        """`count` steps from number `first` on."""
        ...

    def keep(self, carried: Any) -> Any:
        """What is kept at a frame: all but the memory."""
        ...

    def join(self, carried: Any, leading: int = 0) -> Moving:
        """What is carried, or what was kept of it, as it was given, behind `leading` further axes."""
        ...


class WholeSteps(NamedTuple):
    """All lanes at once, a step after the other; by components where the scene says which arrays are vectors."""

    step: Callable[[Array, PyTree], PyTree]
    begun: PyTree
    unrolled: int

    @classmethod
    def of(cls, scene: Scene, step: Step, moving: PyTree, still: PyTree, dt: Array) -> "WholeSteps":
        """What does not change is split here, before the loop."""
        if not splits_vectors():
            return cls(lambda i, moving: step(i, moving, still, dt), moving, 1)
        vectors = scene.build_vector_mask((moving, still))
        begun, still = forget_wholes(split_vectors(moving, vectors[0])), split_vectors(still, vectors[1])
        by_components = compute_by_components(step, jnp.zeros((), jnp.int32), begun, still, dt, like=begun)
        program = by_components.program
        unrolled = 1 if holds_loops(program) else choose_unrolled_steps(count_operations(program))
        return cls(lambda i, moving: by_components(i, moving, still, dt), begun, unrolled)

    def start(self, moving: PyTree) -> PyTree:
        """Components of vectors, other arrays as they are."""
        return self.begun

    def advance(self, carried: PyTree, first: Array, count: int) -> PyTree:
        """A loop that reverse mode goes back through."""
        return repeat_steps(self.step, carried, first, count, unrolled=self.unrolled)

    def keep(self, carried: Moving) -> Moving:
        """The arrays of the scene."""
        return carried._replace(memory=None)

    def join(self, carried: Moving, leading: int = 0) -> Moving:
        """Components are the last axis."""
        return join_vectors(carried)


class BlockedSteps(NamedTuple):
    """Lanes in blocks, one after the other, each through all steps of a frame."""

    scene: Scene
    blocks: Blocks
    step: Step
    still: PyTree
    dt: Array

    def start(self, moving: PyTree) -> PyTree:
        """Cut into blocks."""
        return self.blocks.cut(moving)

    def advance(self, carried: PyTree, first: Array, count: int) -> PyTree:
        """A loop over blocks, with one over steps in it."""

        def advance_block(moving: PyTree, still: PyTree, dt: Array) -> PyTree:
            whole = WholeSteps.of(self.scene, self.step, moving, still, dt)
            return whole.join(whole.advance(whole.start(moving), first, count))

        masks = self.scene.build_lane_mask((self.still, self.dt))
        return self.blocks.map(advance_block, carried, self.still, self.dt, masks=masks)

    def keep(self, carried: Moving) -> Moving:
        """The arrays of the scene."""
        return carried._replace(memory=None)

    def join(self, carried: Moving, leading: int = 0) -> Moving:
        """Blocks side by side."""
        return self.blocks.join(carried, leading)


class KernelSteps(NamedTuple):
    """All steps of a frame in one kernel; what is carried are columns, an array of all lanes for each number of one."""

    kernel: "physjax.kernels.LaneKernel"
    kept: "physjax.kernels.Layout"

    def start(self, moving: Moving) -> list[Array]:
        """Columns."""
        return self.kernel.start(moving)

    def advance(self, carried: list[Array], first: Array, count: int) -> list[Array]:
        """The kernel."""
        return self.kernel.advance(carried, first, count)

    def keep(self, carried: list[Array]) -> list[Array]:
        """The columns of the arrays of the scene, which come first."""
        return carried[: self.kept.count_numbers(own=True)]

    def join(self, carried: list[Array], leading: int = 0) -> Moving:
        """Arrays of all lanes."""
        layout = self.kernel.moving
        return (layout if len(carried) == layout.count_numbers(own=True) else self.kept).join(carried)


def choose_steps(
    scene: Scene, step: Step, moving: PyTree, still: PyTree, dt: Array, *, frame_steps: int, cut: bool, in_kernel: bool
) -> Steps:
    """The way for a scene: with `cut` lanes may go in blocks, and with `in_kernel` all steps of a frame in one kernel."""
    blocks = Blocks.of(scene, moving, frame_steps) if cut else None
    if blocks is not None:
        return BlockedSteps(scene, blocks, step, still, dt)
    kernel = _build_kernel(scene, step, moving, still, dt) if in_kernel else None
    return WholeSteps.of(scene, step, moving, still, dt) if kernel is None else kernel


def _build_kernel(scene: Scene, step: Step, moving: PyTree, still: PyTree, dt: Array) -> Steps | None:
    """The kernel for a scene whose lanes do not see each other; None where it must not be cut or holds what no kernel does."""
    if scene.emitter is not None or not scene.may_be_cut():
        return None
    from physjax.kernels import LaneKernel, Layout  # Pallas takes a while to import

    masks = tuple(map(scene.build_lane_mask, (moving, (still, dt))))
    lanes = scene.state.lanes
    kernel = LaneKernel.of(lambda i, moving, rest: step(i, moving, *rest), lanes, moving, (still, dt), masks)
    if kernel is None:
        return None
    kept = Layout.of(moving._replace(memory=None), masks[0]._replace(memory=None), lanes, kernel.moving.padded)
    return KernelSteps(kernel, kept)
