"""Orbits under Newtonian gravitation."""

import jax.numpy as jnp
import numpy as np

from physjax.particles import Particles
from physjax.physics import forces
from physjax.scene import Scene
from physjax.scenes.registry import read_table, scene
from physjax.study.energy.quantities import ANGULAR_MOMENTUM, ENERGY, MOMENTUM
from physjax.study.problem import Problem, Truth

CONSERVED = (ENERGY, MOMENTUM, ANGULAR_MOMENTUM)


@scene
def kepler(eccentricity: float = 0.9, orbits: int = 2) -> Problem:
    """Two equal bodies on ellipses of eccentricity 0.9: slow far apart, then a short close approach."""
    e = eccentricity
    # relative orbit with semi-major axis 1 and GM = 1, from the closest point: Hairer, Lubich, Wanner, section I.2
    apart = np.array([1 - e, 0.0])
    speed = np.array([0.0, np.sqrt((1 + e) / (1 - e))])
    pair = np.array([[-0.5], [0.5]])
    bodies = Scene(
        Particles(jnp.asarray(pair * apart), jnp.asarray(pair * speed)),
        mass=0.5,
        forces=(forces.Gravitation(G=1.0),),
    )

    def exact(t):
        anomaly = _solve_kepler(np.asarray(t, float), e)[:, None, None]
        rate = 1 / (1 - e * np.cos(anomaly))
        minor = np.sqrt(1 - e**2)
        relative = np.concatenate([np.cos(anomaly) - e, minor * np.sin(anomaly)], axis=-1)
        velocity = rate * np.concatenate([-np.sin(anomaly), minor * np.cos(anomaly)], axis=-1)
        return Particles(pair * relative, pair * velocity)

    return Problem(
        bodies,
        duration=2 * np.pi * orbits,
        exact=exact,
        conserved=CONSERVED,
        truths=(
            Truth(
                "back at the start after T = 2π√(a³/GM) [m]",
                lambda flight: flight.position[-1] - flight.position[0],
                0.0,
                1e-6,
            ),
        ),
        frames=64,
    )


@scene
def figure_eight() -> Problem:
    """Three equal bodies that follow each other along a figure eight (Chenciner and Montgomery 2000)."""
    one = np.array([0.97000436, -0.24308753])
    last = np.array([-0.93240737, -0.86473146])
    bodies = Scene(
        Particles(jnp.asarray(np.stack([one, -one, 0 * one])), jnp.asarray(np.stack([-last / 2, -last / 2, last]))),
        mass=1.0,
        forces=(forces.Gravitation(G=1.0),),
    )
    return Problem(
        bodies,
        duration=6.32591398,
        conserved=CONSERVED,
        truths=(
            Truth(
                "back at the start after one period [m]",
                lambda flight: flight.position[-1] - flight.position[0],
                0.0,
                1e-6,
            ),
        ),
    )


@scene
def solar_system() -> Problem:
    """Sun, planets and Pluto for ten years from JPL's DE421 positions, by Newton's gravitation alone."""
    ephemeris = read_table("solar_system_de421.csv")
    dates = ephemeris["julian_date_tdb"]
    start, end = dates == dates.min(), dates == dates.max()
    position = np.stack([ephemeris[c] for c in ("x_m", "y_m", "z_m")], axis=-1)
    velocity = np.stack([ephemeris[c] for c in ("vx_m_s", "vy_m_s", "vz_m_s")], axis=-1)
    gm = ephemeris["gm_m3_s2"][start]
    gravitation = forces.Gravitation(gm=gm)
    bodies = Scene(
        Particles(jnp.asarray(position[start]), jnp.asarray(velocity[start])),
        mass=gm / 6.67430e-11,
        forces=(gravitation,),
    )
    names = ephemeris["body"][start]
    # differences to Newton's law after ten years [km]: relativity, asteroids, the Moon as a separate body
    missing = {"mercury": 1823, "venus": 901, "earthmoon": 561, "mars": 341, "jupiter": 72.2, "saturn": 15.5}
    missing |= {"uranus": 0.38, "neptune": 0.155, "pluto": 0.24}
    known = np.array([name in missing for name in names])
    expected = np.array([missing[name] for name in names[known]])
    return Problem(
        bodies,
        duration=float((dates.max() - dates.min()) * 86400.0),
        conserved=CONSERVED,
        truths=(
            Truth(
                "after ten years, differs from DE421 by what Newton's law lacks, planet by planet [km]",
                lambda flight: np.linalg.norm(flight.position[-1] - position[end], axis=-1)[known] / 1e3,
                expected,
                0.05 * expected,
            ),
        ),
        frames=40,
    )


def _solve_kepler(mean: np.ndarray, e: float) -> np.ndarray:
    """Solve Kepler's equation E - e sin E = M by Newton's method from E = π, which converges for every e < 1."""
    turns = np.floor(mean / (2 * np.pi))
    mean = mean - 2 * np.pi * turns
    anomaly = np.full_like(mean, np.pi)
    for _ in range(60):
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - mean) / (1 - e * np.cos(anomaly))
    return anomaly + 2 * np.pi * turns
