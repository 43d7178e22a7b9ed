"""What `aim_at` is given, checked before anything is searched."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from physjax.checks import as_positive_integer, as_real_quantity, concrete_or_none, demand_all
from physjax.particles import Particles, demand_particles
from physjax.parts import as_module
from physjax.physics.contacts.time_of_impact import impact
from physjax.scene import Scene
from physjax.study.inverse.shooting import AimProblem
from physjax.vectors import norm


def check_bounces(bounces: int, speed: ArrayLike | None, scene: Scene) -> int:
    """The number of bounces, or a ValueError where a scene has none of that kind."""
    bounces = as_positive_integer("bounces", bounces, at_least=0)
    if bounces and speed is None:
        raise ValueError(
            "aim_at: got bounces without speed=, expected a speed: the least is found in free flight only."
        )
    if bounces and not any(contact.response is impact for contact in scene.contacts):
        raise ValueError(
            f"bounces: got {bounces} in a scene without contacts that find the moment of impact, expected some, e.g. "
            "contacts=(contacts.Plane(point=(0, 0), normal=(0, 1), restitution=0.8),)."
        )
    return bounces


def check_problem(
    scene: Scene,
    target: ArrayLike | Callable,
    method: Callable[..., PyTree],
    steps: int,
    launcher: ArrayLike | None,
    target_velocity: ArrayLike | None,
) -> AimProblem:
    """Scene and targets with the same lanes, or an error that says what does not fit."""
    if not isinstance(scene, Scene):
        raise TypeError(f"aim_at: got a {type(scene).__name__}, expected a Scene whose position is where it is fired.")
    if not callable(method):
        raise TypeError(f"aim_at: got the method {method!r}, expected a method of stepping, e.g. methods.rk4.")
    steps = as_positive_integer("steps", steps)
    _demand_free_shots(scene)
    if callable(target):
        path = as_module(target)
        start, target_velocity = _read_path(path, scene, target_velocity)
    else:
        path, start = None, target
    target, shape = _match_targets(scene, start)
    position = jnp.broadcast_to(scene.state.position, shape)
    away = norm(target - position)
    known_away = concrete_or_none(away)
    if known_away is not None:
        demand_all("distance from launch to target [m]", away, known_away > 0, "a target away from the launch")
    at_rest = Particles(position, jnp.zeros_like(position))
    launcher, target_velocity = (
        None if velocity is None else _spread_velocity(name, velocity, position)
        for name, velocity in (("launcher_velocity", launcher), ("target_velocity", target_velocity))
    )
    return AimProblem(scene.replace(state=at_rest), target, as_module(method), steps, launcher, target_velocity, path)


def _read_path(path: Callable, scene: Scene, target_velocity: ArrayLike | None) -> tuple[Array, Array]:
    """Where a path starts [m] and how fast [m/s], or a ValueError where it is not that of one place."""
    if target_velocity is not None:
        raise ValueError("aim_at: got a path and target_velocity=, expected one of them: a path says how fast it is.")
    start = jnp.zeros((), scene.state.dtype)
    place, velocity = jax.jvp(lambda t: jnp.asarray(path(t)), (start,), (jnp.ones_like(start),))
    if place.shape != scene.state.position.shape[-1:]:
        raise ValueError(
            f"target: got a path to places of shape {place.shape}, expected {scene.state.position.shape[-1:]}, a function of "
            "the time since the launch, (t) -> place [m], the same for all shots."
        )
    return place, velocity


def _demand_free_shots(scene: Scene) -> None:
    """Raise an error unless the lanes of a scene are particles whose launch is free and that fly each on its own."""
    demand_particles("aim_at", scene.state, "a launch is a position and a velocity")
    if scene.pinned is not None:
        raise ValueError("aim_at: got a scene with pinned lanes, expected a launch velocity that is free. Unpin them.")
    if scene.couples:
        raise ValueError(
            "aim_at: got a scene whose forces couple its lanes, expected shots that fly each on its own. Wrap a plain "
            "function that looks at its own lane only in forces.independent."
        )
    dim = scene.state.position.shape[-1]
    if dim not in (2, 3):
        raise ValueError(f"aim_at: got positions with {dim} components, expected 2 or 3.")


def _match_targets(scene: Scene, target: ArrayLike) -> tuple[Array, tuple[int, ...]]:
    """One target [m] for each shot, and the shape of their places: one lane is for all targets, one target for all lanes."""
    position = scene.state.position
    target = as_real_quantity("target [m]", target).astype(position.dtype)
    if target.ndim == 0 or target.shape[-1] != position.shape[-1]:
        raise ValueError(
            f"target [m]: got shape {target.shape}, expected (*lanes, {position.shape[-1]}), as many components as the "
            "scene has."
        )
    lanes, here = target.shape[:-1], scene.state.lanes
    if lanes and here and lanes != here:
        raise ValueError(
            f"target [m]: got targets of shape {lanes} for a scene of {here} lanes, expected one lane for all targets, "
            "one target for all lanes, or one for each."
        )
    shape = (lanes or here) + position.shape[-1:]
    return jnp.broadcast_to(target, shape), shape


def _spread_velocity(name: str, velocity: ArrayLike, position: Array) -> Array:
    """One velocity [m/s] for each shot."""
    velocity = as_real_quantity(f"{name} [m/s]", velocity).astype(position.dtype)
    for_all, one_each = position.shape[-1:], position.shape
    if velocity.shape not in (for_all, one_each):
        raise ValueError(
            f"{name} [m/s]: got shape {velocity.shape}, expected {for_all} for all shots or {one_each}, one each."
        )
    return jnp.broadcast_to(velocity, position.shape)


__all__ = ["check_bounces", "check_problem"]
