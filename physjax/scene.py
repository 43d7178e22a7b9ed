"""The nouns: what a scene is made of, and what a force is.

Arrays are shaped `(*lanes, dim)`, the component last. Lanes are independent (ten thousand balls) or coupled (bodies
that attract each other, a cloth's nodes); a force says which. In a coupled scene the last lane axis counts nodes and
earlier axes count scenes. A per-lane number is a scalar or has the shape of the lanes. SI units, y up
unless a force says otherwise.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from physjax.backend import MIN_LANES_TO_SELECT, evaluate_coupled, needs_split_compilation
from physjax.loops import (
    RECORD,
    Time,
    is_library_part,
    respond_at_float_time,
    time_for_method,
    time_for_part,
    to_float_time,
)
from physjax.memory_masks import build_advance_mask, build_memory_mask
from physjax.particles import Particles, demand_state_record
from physjax.parts import (
    Contact,
    Force,
    ParticleSource,
    as_module,
    as_tuple,
    find_plain_functions,
    prepare_contact,
    prepare_force,
    unify_gravity,
)
from physjax.pins import Pins, as_mask
from physjax.quantities import (
    build_lane_mask,
    build_vector_mask,
    demand_fitting_numbers,
    mark_invalid_lanes,
    may_hide_lanes,
)
from physjax.stages import Stage, advance_force, close_joints, prescribe, resolve_contact
from physjax.summaries import represent_scene, tabulate_scene
from physjax.tracebacks import Module
from physjax.trials import find_faulty_force


def project(motion: Callable, scene: "Scene", t: Time, dt: ArrayLike) -> "Scene":
    """The lecture's response: step as if nothing were there, then move back and reflect what is inside.

    Cheap and robust, first order in dt: a bounce happens at the end of the step, not at the time of impact, and a
    lane that crosses a thin obstacle within one step is missed.

    Example:
        >>> floor = contacts.Plane((0.0, 0.0), (0.0, 1.0), restitution=0.5, response=contacts.project)
        >>> falling = Scene(Particles(jnp.array([0.0, 1.0]), jnp.array([0.0, -2.0])), contacts=(floor,))
        >>> end = falling.step(methods.euler, 0.0, 1.0).state
        >>> print(end.position, end.velocity)
        [0. 0.] [0. 1.]
    """
    scene = motion(scene, t, dt)
    state = scene.state
    for contact in scene.contacts:
        if (contact.response or project) is project:
            state = contact.resolve(to_float_time(t + dt), state, scene.mass)
    return scene.replace(state=state)


class Scene(Module):
    """Everything a run needs but the method: state, mass [kg], forces, contacts, which lanes are held, prescribed or born.

    `mass` is a scalar or per lane, an `Inertia` for rigid bodies. `forces` are library forces or any callable
    `(t, state, mass) -> newtons`. `pinned` is a boolean mask over the lanes that are held, or `Pins(nodes, path)`, which
    prescribes their motion. With an `emitter` the lanes are born and die. Every number becomes an array of the state's dtype:
    changing it does not recompile, and it can be swept and differentiated. Raises ValueError or TypeError for shapes that
    do not match, numbers that are not finite, and masses <= 0.

    Example:
        >>> scene = Scene(ball, mass=0.5, forces=(forces.Gravity(), forces.StokesDrag(0.5)))
        >>> print(scene.acceleration(0.0, scene.state))
        [ -3.  -13.8]
    """

    state: PyTree = eqx.field(metadata=RECORD)
    mass: PyTree = eqx.field(metadata=RECORD)
    forces: tuple
    contacts: tuple
    pinned: Bool[Array, "*lanes"] | Pins | None = eqx.field(metadata=RECORD)
    emitter: ParticleSource | None
    reaction: Callable | None = eqx.field(init=False)

    @jax.transfer_guard("allow")  # what a scene is given goes to the device on purpose
    def __init__(
        self,
        state: PyTree,
        mass: PyTree = 1.0,
        forces: Sequence[Callable] = (),
        contacts: Sequence[Contact] = (),
        pinned: ArrayLike | Pins | None = None,
        emitter: ParticleSource | None = None,
    ):
        demand_state_record(state)
        state, mass = state.validate(mass)
        lanes, dtype = state.lanes, state.dtype
        if isinstance(pinned, Pins):
            pinned = pinned.prepare(state)
            state = pinned.prescribe(0.0, state)
        elif pinned is not None:
            pinned = as_mask("pinned", pinned)
            if pinned.dtype != bool or pinned.shape != lanes:
                raise ValueError(
                    f"pinned: got {pinned.dtype} of shape {pinned.shape}, expected booleans of the lanes' shape {lanes}."
                )
            state = state.hold_lanes(1 - pinned.astype(dtype))
        self.mass = mass
        forces = [prepare_force(force, dtype) for force in as_tuple("force", forces)]
        self.forces = unify_gravity(forces, state.position.shape[-1])
        if emitter is not None and self.constraints:
            raise ValueError(
                "Scene: got an emitter and joints, expected one of them: joined bodies live from the start."
            )
        self.contacts = tuple(prepare_contact(contact, dtype) for contact in as_tuple("contact", contacts))
        for part in (*self.forces, *self.contacts):
            demand_fitting_numbers(part, lanes, state.position.shape[-1])
        for contact in self.contacts:
            contact.demand_fit(state, mass)
        self.forces = tuple(force.prepare(state, mass) for force in self.forces)
        for force in self.forces:
            force.demand_company(self.forces)
        if (fault := find_faulty_force(state, mass, self.forces)) is not None:
            raise TypeError(fault)
        self.state = state = mark_invalid_lanes(
            state, mass, (*self.forces, *self.contacts, pinned, emitter), self.contacts
        )
        self.contacts = tuple(contact.prepare(state, self.couples) for contact in self.contacts)
        self.pinned = pinned
        self.reaction = None
        self.emitter = None if emitter is None else emitter.prepare(self)

    __repr__, _repr_html_ = represent_scene, tabulate_scene

    @property
    def couples(self) -> bool:
        """Whether any force or contact ties lanes together; a plain function counts as one that does."""
        return any(part.couples for part in (*self.forces, *self.contacts))

    @property
    def up(self) -> int:
        """The axis that points up: that of the weight, else of what else has an `up`, else y, of a line the only one."""
        axes = [force.up_axis for force in sorted(self.forces, key=lambda force: not force.is_field)]
        known = [axis for axis in axes if axis is not None]
        return known[0] if known else min(1, self.state.position.shape[-1] - 1)

    @property
    def held(self) -> Bool[Array, "*lanes"] | None:
        """Mask of the lanes that no force moves, held where they are or moved along a path; None where there are none."""
        return self.pinned.nodes if isinstance(self.pinned, Pins) else self.pinned

    @property
    def prescribed_motion(self) -> Pins | None:
        """The `Pins` that move kinematic lanes along a path; None without."""
        return self.pinned if isinstance(self.pinned, Pins) else None

    @property
    def compiles_in_pieces(self) -> bool:
        """Whether a step is compiled in pieces, as it is where more than a few nodes are coupled."""
        return needs_split_compilation(self.couples, self.state.lanes)

    @property
    def compile_bound(self) -> bool:
        """Whether compiling a step costs more than taking it: few lanes, and contacts timed within it, or joints."""
        timed = bool(self.constraints) or any((c.response or project) is not project for c in self.contacts)
        return timed and math.prod(self.state.lanes) < MIN_LANES_TO_SELECT

    def may_be_cut(self) -> bool:
        """Whether some lanes can be stepped without the rest: independent ones, and no part may hide an array of all lanes.

        A plain function may close over one, a path has one, and so may a part whose arrays are not declared.
        """
        hiding = find_plain_functions([force for force in self.forces if not force.lane_by_lane])
        whole = self.couples or self.prescribed_motion is not None or bool(hiding)
        return not whole and not may_hide_lanes(self, self.state.lanes, self.state.position.shape[-1])

    def build_lane_mask(self, tree: PyTree) -> PyTree:
        """The tree with True in place of each array that has an entry for each lane of this scene, False elsewhere."""
        return build_lane_mask(tree, self.state.lanes, self.state.position.shape[-1])

    def build_vector_mask(self, tree: PyTree) -> PyTree:
        """The tree with True in place of each array whose last axis counts the components of a vector, False elsewhere."""
        return build_vector_mask(tree, self.state.lanes, self.state.position.shape[-1])

    @property
    def only_moves(self) -> bool:
        """Whether a step is the method's alone: no contact, birth or path within it, and no memory after it."""
        alone = not self.contacts and self.emitter is None and self.prescribed_motion is None
        return alone and not self.remembers and not self.constraints

    @property
    def constraints(self) -> tuple[Force, ...]:
        """What the scene holds exactly: joints and rods."""
        return tuple(force for force in self.forces if force.response is not None)

    @property
    def remembers(self) -> bool:
        """Whether a force remembers: springs that break."""
        return any(force.remembers for force in self.forces)

    @property
    def resolves_at_step_end(self) -> bool:
        """Whether something that happens within a step is seen at its end: a projected contact, a spring that breaks."""
        return self.remembers or any((contact.response or project) is project for contact in self.contacts)

    @property
    def status_shape(self) -> tuple[int, ...]:
        """Shape of what is decided once a scene when lanes are coupled, once a lane when not: status and step size."""
        return self.state.lanes[:-1] if self.couples else self.state.lanes

    def changing(self) -> "Scene":
        """The scene with True in place of each array that a step may change, False elsewhere.

        Those are the state, what contacts and the emitter declare as their `memory`, and what `advance` replaces in a
        force with memory, which is found by tracing it and comparing identities.
        """
        return self.replace(
            state=jax.tree.map(lambda _: True, self.state),
            mass=jax.tree.map(lambda _: False, self.mass),
            forces=tuple(build_advance_mask(force, *self._view(force)) for force in self.forces),
            contacts=tuple(map(build_memory_mask, self.contacts)),
            pinned=jax.tree.map(lambda _: False, self.pinned),
            emitter=build_memory_mask(self.emitter),
            reaction=jax.tree.map(lambda _: False, self.reaction),
        )

    def acceleration(self, t: Time, state: Particles) -> Float[Array, "*lanes dim"]:
        """Newton's second law for particles, a = ΣF/m [m/s²]; held lanes do not accelerate, kinematic ones as their path does."""
        return self.rate(t, state).velocity if self.constraints else state.generalised_force(self, t)

    def rate(self, t: Time, state: PyTree) -> PyTree:
        """Time derivative of the whole state: the right-hand side of the equations of motion."""
        if not self.compiles_in_pieces:
            rate = state.rate(state.generalised_force(self, t), self.mass)
        else:
            force = evaluate_coupled(to_float_time(t), lambda state: state.generalised_force(self, t), state)
            rate = state.rate(force, self.mass)
        constraints = self.constraints
        return constraints[0].constrain_rate(self, t, state, rate) if constraints else rate

    def kick(self, state: PyTree, rate: PyTree, dt: ArrayLike) -> PyTree:
        """Velocities (of bodies the momenta) changed by what `rate` says for a time dt."""
        return state.kick(rate, dt)

    def drift(self, state: PyTree, dt: ArrayLike) -> PyTree:
        """Positions (of bodies also orientations) moved by the velocities in `state` for a time dt."""
        return state.drift(dt, self.mass)

    def normalised(self, state: PyTree) -> PyTree:
        """The state as it must be after a step, where its arrays have to agree with each other."""
        return state.normalised(self.mass)

    def _view(self, force: Force) -> tuple[PyTree, PyTree]:
        """The state and the mass that a force sees."""
        return self.state.view_for_force(force, self.mass)

    def averaged_over_step(self, t: Time, dt: ArrayLike) -> "Scene":
        """The scene as one step sees it: forces that jump in time replaced by their mean over the step."""
        average = lambda f: f.averaged_over_step(time_for_part(f, t), dt, self._view(f)[0]) if f.jumps else f  # noqa: E731
        return eqx.tree_at(lambda scene: scene.forces, self, tuple(map(average, self.forces)))

    @property
    def dissipative_symmetric(self) -> bool:
        """Whether every force resists motion with a symmetric Jacobian: an implicit step may then use conjugate gradients."""
        return not self.state.rotates and all(force.dissipative_symmetric for force in self.forces)

    def linearised_at(self, t: Time, state: PyTree) -> "Scene":
        """The scene that an implicit step differentiates at this state in place of this one."""
        state = state if self.prescribed_motion is None else self.prescribed_motion.prescribe(to_float_time(t), state)
        see = lambda f: state.view_for_force(f, self.mass)  # noqa: E731
        linearise = lambda f: f.linearised_at(time_for_part(f, t), *see(f)) if f.has_linearisation else f  # noqa: E731
        return self.replace(forces=tuple(map(linearise, self.forces)))

    def step(self, method: Callable, t: Time, dt: ArrayLike) -> "Scene":
        """The scene after a step from t to t + dt [s]: its stages, one after the other."""
        scene = self
        for stage in self.stages(method, t, dt):
            scene = stage.run(scene)
        return scene

    def stages(self, method: Callable, t: Time, dt: ArrayLike) -> "tuple[Stage, ...]":
        """What a step consists of, in order, each a function of the scene that the stage before has left.

        "move": the method's step, with what contacts resolve within it (all of them where an emitter gives each
        particle a step of its own); "resolve contacts": each contact that projects; "prescribe": kinematic nodes are
        put on their path, held ones back in their place; "close joints": what contacts have pulled off its joints is put
        back on them; "advance memory": each force with memory. A method that
        subdivides the step goes through all of them in each of its own.
        """
        if isinstance(method, SubdividingMethod) and not self.only_moves and self.emitter is None:
            return (Stage("move", lambda scene: method.step_scene(scene, t, dt)),)
        emitter, motion = self.emitter, self._motion(method)
        if emitter is None:
            stages = [Stage("move", lambda scene: motion(scene, t, dt))]
            stages += [
                Stage("resolve contacts", partial(resolve_contact, i, t=t + dt), i)
                for i, contact in enumerate(self.contacts)
                if (contact.response or project) is project
            ]
        else:
            stages = [Stage("move", lambda scene: emitter.live(motion, scene, t, dt))]
        if self.prescribed_motion is not None or (self.contacts and self.pinned is not None):
            stages.append(Stage("prescribe", partial(prescribe, start=self.state, t=t + dt)))
        if self.constraints and self.contacts:
            stages.append(Stage("close joints", close_joints))
        stages += [
            Stage("advance memory", partial(advance_force, i, t=to_float_time(t), dt=dt), i)
            for i, force in enumerate(self.forces)
            if force.remembers
        ]
        return tuple(stages)

    def _motion(self, method: Callable) -> Callable:
        """The method's step within the responses of the contacts; `project` is outside of it but under an emitter."""
        motion = self.constrained_motion(method)
        responses = dict.fromkeys(contact.response or project for contact in self.contacts)
        # what is resolved at the end of the step comes last
        for response in sorted(responses, key=lambda response: response is project):
            if response is project and self.emitter is None:
                continue
            ours = is_library_part(response)
            motion = Partial(response, motion) if ours else Partial(respond_at_float_time, as_module(response), motion)
        return motion

    def constrained_motion(self, method: Callable) -> Callable:
        """The method's step as if nothing were in the way, kept on what the scene holds exactly."""
        motion = Partial(free_motion, as_module(method))
        for response in dict.fromkeys(constraint.response for constraint in self.constraints):
            motion = Partial(response, motion)
        return motion

    def replace(self, **parts: PyTree) -> "Scene":
        """The scene with some of its parts replaced, unchecked."""
        names = list(parts)
        where = lambda scene: [getattr(scene, name) for name in names]  # noqa: E731
        return eqx.tree_at(where, self, list(parts.values()), is_leaf=lambda leaf: leaf is None)

    having = replace
    """The name of the first edition."""

    def finite(self, state: PyTree) -> Bool[Array, "..."]:
        """Whether the state is finite, per lane, or per scene where lanes are coupled."""
        lanes = len(state.lanes)
        status = [
            jnp.all(jnp.isfinite(leaf), axis=-1) if leaf.ndim > lanes else jnp.isfinite(leaf)
            for leaf in jax.tree.leaves(state)
        ]
        good = jnp.all(jnp.stack(status), axis=0)
        return jnp.all(good, axis=-1) if self.couples and good.ndim else good


@runtime_checkable
class SubdividingMethod(Protocol):
    """A method that takes steps of its own within dt, and so asks forces that jump for their mean itself."""

    def __call__(self, system: Scene, t: Time, state: PyTree, dt: ArrayLike) -> PyTree:
        """The state after dt."""
        ...

    def step_scene(self, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
        """The scene after dt, all that belongs to a step done in each of its own."""
        ...


def free_motion(method: Callable, scene: Scene, t: Time, dt: ArrayLike) -> Scene:
    """A step of the method as if nothing were in the way; one that subdivides dt asks for what jumps in it by itself."""
    seen = scene if isinstance(method, SubdividingMethod) else scene.averaged_over_step(t, dt)
    return scene.replace(state=scene.normalised(method(seen, time_for_method(method, t), scene.state, dt)))


def loads(scene: Scene, t: Time, state: PyTree = None, *, per_term: bool = False) -> PyTree:
    """Total force on each lane [N] (the lecture's ComputeTotalForce), at `scene.state` unless a state is given.

    Returns an array shaped like the velocity, for rigid bodies a `Wrench` of force [N] and torque about the centre of
    mass [N m]; with `per_term=True` a tuple of such, one for each of `scene.forces`.

    Example:
        >>> print(loads(Scene(ball, mass=2.0, forces=(forces.Gravity(), forces.Constant((5.0, 20.0)))), 0.0))
        [5.  0.4]
    """
    state = scene.state if state is None else state
    terms = tuple(state.evaluate_load(force, t, scene.mass) for force in scene.forces)
    return terms if per_term else state.sum_loads(terms)
