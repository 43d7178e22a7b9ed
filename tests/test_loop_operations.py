"""What a GPU would suffer from is counted in lowered programs, as if for one, so that it is seen without one.

`python tests/test_loop_operations.py` prints the table anew.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loop_operations import LoopCounts, count_in_loops

from physjax import (
    Particles,
    Scene,
    backend,
    contacts,
    emitters,
    forces,
    inertia,
    lattices,
    methods,
    rigid,
    simulate,
    springs,
)

LANES = 4099
"""As many as are picked in groups where few are flagged; no other axis of a program has this length."""
DRAG = (forces.Gravity(), forces.QuadraticDrag(0.01, 0.5, wind=(1.0, 0.0, 0.0)))


def throws(dim=3):
    x, v = np.random.default_rng(0).normal(size=(2, LANES, dim))
    return Particles(jnp.asarray(x + 10 * np.eye(dim)[1]), jnp.asarray(v))


def floor(**options):
    return (contacts.Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), restitution=0.8, **options),)


def build_cloth(*, layout=None, windy=False):
    cloth = lattices.cloth(2.0, 1.0, rows=19, columns=23, mass=0.6, structural=100.0, shear=50.0)
    pulls = cloth.springs
    if layout is not None:
        pulls = springs.Springs(pulls.pairs, pulls.stiffness, pulls.rest_length, layout=layout)
    pushes = (cloth.wind((1.0, 0.0, 0.0)),) if windy else ()
    return Scene(cloth.state, cloth.mass, (forces.Gravity(), pulls, *pushes), pinned=cloth.nodes["top"])


def build_fountain():
    source = emitters.Emitter(LANES, emitters.Point((0.0, 0.0, 0.0)), key=0, life=1.0, speed=5.0, rate=1000.0)
    still = Particles(jnp.zeros((LANES, 3)), jnp.zeros((LANES, 3)))
    return Scene(still, 1.0, DRAG, floor(response=contacts.project), emitter=source)


def build_boxes():
    brick = inertia.box(2.0, (1.0, 2.0, 3.0))
    bodies = rigid.bodies(brick, np.zeros((LANES, 3)), angular_velocity=(1.0, 2.0, 3.0))
    return Scene(bodies, brick, (forces.Gravity(),))


WORKLOADS = {
    "flight": (lambda: Scene(throws(), 1.0, (*DRAG, forces.Magnus(1e-3, 0.2, (0.0, 0.0, 1.0)))), methods.rk4),
    "fall in the plane": (lambda: Scene(throws(2), 1.0, (forces.Gravity(), forces.StokesDrag(0.1))), methods.verlet),
    "n-body": (lambda: Scene(throws(), 1.0, (forces.Gravitation(1.0, softening=0.1),)), methods.leapfrog),
    "cloth": (build_cloth, methods.semi_implicit_euler),
    "cloth by gathering": (partial(build_cloth, layout="gather"), methods.semi_implicit_euler),
    "flag in the wind": (partial(build_cloth, windy=True), methods.rk4),
    "projected contact": (lambda: Scene(throws(), 1.0, DRAG, floor(response=contacts.project)), methods.rk4),
    "timed impacts": (lambda: Scene(throws(), 1.0, DRAG, floor()), methods.rk4),
    "emitter": (build_fountain, methods.verlet),
    "adaptive steps": (lambda: Scene(throws(), 1.0, DRAG), methods.adaptive(methods.rk4)),
    "implicit steps": (lambda: Scene(throws(), 1.0, DRAG), methods.implicit_euler),
    "free bodies": (build_boxes, methods.rk4),
}


def lower(name, monkeypatch, steps=8):
    """A run of some steps, lowered as if for a GPU."""
    monkeypatch.setattr(backend, "device_kind", lambda: "gpu")
    monkeypatch.setattr("physjax.stepping.frames.choose_unrolled_steps", lambda _: 1)
    build, method = WORKLOADS[name]
    with jax.enable_x64(False):
        scene = build()
        return jax.jit(lambda scene: simulate(scene, method, dt=0.01, steps=steps, save_every=4).state).lower(scene)


def measure(name, monkeypatch, steps=8):
    """The counts of a run of some steps."""
    return count_in_loops(lower(name, monkeypatch, steps), 19 * 23 if "cloth" in name or "flag" in name else LANES)


COUNTS = {
    "flight": LoopCounts(on_vectors=0, branches=0, loops=1),
    "fall in the plane": LoopCounts(on_vectors=0, branches=0, loops=1),
    "n-body": LoopCounts(on_vectors=0, branches=0, loops=3),  # two are within a kernel, which is interpreted here
    "cloth": LoopCounts(on_vectors=0, branches=0, loops=1),
    "cloth by gathering": LoopCounts(on_vectors=0, branches=0, loops=1),
    "flag in the wind": LoopCounts(on_vectors=0, branches=0, loops=1),
    "projected contact": LoopCounts(on_vectors=0, branches=0, loops=1),
    "timed impacts": LoopCounts(on_vectors=0, branches=18, loops=3),
    "emitter": LoopCounts(on_vectors=8, branches=1, loops=4),
    "adaptive steps": LoopCounts(on_vectors=0, branches=0, loops=2),
    "implicit steps": LoopCounts(on_vectors=0, branches=0, loops=1),
    "free bodies": LoopCounts(on_vectors=0, branches=0, loops=1),
}
"""In the loop over steps; the loop itself is one of the loops."""


@pytest.mark.parametrize("name", WORKLOADS)
def test_a_step_holds_no_more_of_what_slows_a_gpu(name, monkeypatch):
    found = measure(name, monkeypatch)
    assert all(count <= most for count, most in zip(found, COUNTS[name], strict=True)), found


@pytest.mark.parametrize(("name", "stores"), [("cloth", 1), ("cloth by gathering", 1), ("flag in the wind", 8)])
def test_coupled_nodes_are_stored_where_neighbours_read_them_and_nowhere_else(name, stores, monkeypatch):
    # a store ends a kernel: the state before each stage of a step, the forces on faces before nodes sum them
    assert lower(name, monkeypatch).as_text().count("stablehlo.optimization_barrier") == stores


@pytest.mark.parametrize("name", ["flight", "fall in the plane"])
def test_whole_vectors_are_seen_where_nothing_splits_them(name, monkeypatch):
    monkeypatch.setattr("physjax.components.interpreter.ARRAY_RULES", {})
    # a run of another length is traced anew
    assert measure(name, monkeypatch, steps=12).on_vectors > 20


if __name__ == "__main__":
    with pytest.MonkeyPatch.context() as patch:
        for name in WORKLOADS:
            print(f'    "{name}": {measure(name, patch)},', flush=True)
