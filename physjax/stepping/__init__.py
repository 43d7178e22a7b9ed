"""How a scene moves: the methods, the loop that repeats their steps, and the bridge to diffrax.

# A walk with dt

`simulate` checks it: one number, or one for each lane or coupled scene, cast to the state's type. The compiled loop carries
only what `Scene.changing` marks and repeats a step as `frames.choose_steps` says. Step i starts at `loops.moment_at(i, dt)`:
time is counted, never accumulated. `Scene.step` runs the `Scene.stages` of that step. In "move", forces that jump in time
are replaced by their mean over the step (`averaged_over_step(t, dt)`) and the method is called; `methods.rk4` asks for the
rate at t, t + dt/2 and t + dt and adds dt/6 of the slopes. Where contacts use `impact`, `physjax.physics.contacts.time_of_impact`
wraps that motion and cuts dt into legs, each up to the next time of impact, and the contact is resolved between them.
Contacts that use `project` are resolved afterwards ("resolve contacts"), at t + dt. Then "prescribe" puts kinematic nodes
where their path is at t + dt, and "advance memory" lets springs break. The `Trajectory` keeps dt, so that `crossing` and the
energy audit can take the same steps again.

# A step a frame

A game takes one step a frame: `scene.step` under `jit` is the step that `simulate` takes, and what the player does is a number
that may change.

Example:
    >>> push = forces.Constant((0.0, 0.0))
    >>> court = Scene(Particles(jnp.zeros(2), jnp.zeros(2)), mass=0.5, forces=(forces.Gravity(), push))
    >>> @jax.jit
    ... def frame(scene, number, push, dt=1 / 60):
    ...     steered = scene.replace(forces=(scene.forces[0], forces.Constant(push)))
    ...     return steered.step(methods.rk4, number * dt, dt)
    >>> for number in range(60):  # compiled once
    ...     court = frame(court, number, jnp.array([0.5, 0.0]))
    >>> round(float(court.state.velocity[0]), 3)
    1.0

# On a GPU

The vectors of a step are carried by components, and a run of independent lanes takes all steps between two frames in one
kernel, written from the same step, impacts, error control and bodies included, up to a step of 5000 operations. Derivatives,
and runs inside a `jit` or `vmap` of your own, take a loop that does several steps a launch. Lanes over several GPUs: put the
arrays of a scene there with `jax.device_put` and a `jax.sharding.NamedSharding` along the lanes; such runs take the loop. A
run whose frames cannot fit is refused before it begins, with what would fit.

# Known limitations

- Time is the number of steps times dt in the state's type, so a float32 clock may be off by 5 ms after a day. Kicks,
  controls and births are applied completely and at the right step by that clock; your own force or path sees a float32
  time, which resolves only 8 ms by then. A run ends before step 2³¹.
- Reverse mode costs about two forward runs, with springs ten to twenty, and memory for the frames plus √(steps between
  them): save fewer frames for long gradients.
- The same program with the same shapes gives the same bits, also when resumed; another batch shape agrees to rounding.
- In float32 and SI units, lengths beyond about 1e12 m overflow when distances are cubed: the solar system needs float64.
- JAX keeps every program that it has compiled: a scene with new shapes, parts or functions takes 2 MB (4 on jax 0.10.1), one
  with new numbers nothing. If thousands of different scenes pass through one process, call `jax.clear_caches()` now and
  then: it frees them all, and what is used again recompiles.
- `reference` refuses contacts and springs that break.
"""

from physjax.lazy import serve_submodules

__all__, __getattr__, __dir__ = serve_submodules(__name__, __path__)
