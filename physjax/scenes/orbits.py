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
    return _build_two_bodies(eccentricity, orbits, share=0.5)


@scene
def comet(eccentricity: float = 0.99) -> Problem:
    """A comet on an ellipse of eccentricity 0.99: at the sun it is 199 times as fast as far out, where it starts."""
    # an odd number of frames: at the sun itself no reference is good to nine digits
    return _build_two_bodies(eccentricity, 1, share=1e-3, from_far=True)._replace(frames=63)


def _build_two_bodies(e: float, orbits: int, share: float, *, from_far: bool = False) -> Problem:
    """Two bodies of the mass 1 together, the second with this share of it, from their closest or their farthest point on."""
    # relative orbit with semi-major axis 1 and GM = 1: Hairer, Lubich, Wanner, section I.2
    side = -1.0 if from_far else 1.0
    apart = np.array([side - e, 0.0])
    speed = np.array([0.0, side * np.sqrt((1 + side * e) / (1 - side * e))])
    pair = np.array([[-share], [1 - share]])
    bodies = Scene(
        Particles(jnp.asarray(pair * apart), jnp.asarray(pair * speed)),
        mass=jnp.asarray([1 - share, share]),
        forces=(forces.Gravitation(G=1.0),),
    )

    def exact(t):
        anomaly = _solve_kepler(np.asarray(t, float) + (np.pi if from_far else 0.0), e)[:, None, None]
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
def pythagorean() -> Problem:
    """Masses 3, 4 and 5 fall from the corners of a triangle, pass within 1/2300 of its side, and one escapes."""
    # C. Burrau 1913; V. Szebehely and C. F. Peters, Astron. J. 72 (1967) 876. The positions are our own, integrated by
    # extrapolation (Gragg, Bulirsch, Stoer) in 34 digits, of which errors take up to nine on the way
    bodies = Scene(
        Particles(jnp.asarray([[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]]), jnp.zeros((3, 2))),
        mass=jnp.asarray([3.0, 4.0, 5.0]),
        forces=(forces.Gravitation(G=1.0),),
    )
    after_ten = np.array(
        [
            [0.77848041013808549, 0.14139230029008617],
            [-2.0250924779781986, 0.097219384146058397],
            [1.1529857362997076, -0.16261089088749892],
        ]
    )

    def measure_escape(flight):
        x, mass = flight.position[-1], np.array([4.0, 5.0])
        return np.linalg.norm(x[0] - mass @ x[1:] / 9.0)

    return Problem(
        bodies,
        duration=70.0,
        conserved=CONSERVED,
        truths=(
            Truth("where they are at t = 10 [1]", lambda flight: flight.position[10], after_ten, 1e-7),
            Truth(
                "the lightest has left the others by t = 70, its distance to their centre [1]",
                measure_escape,
                28.553,
                1.0,
            ),
        ),
        frames=70,
    )


@scene
def solar_system() -> Problem:
    """Sun, planets and Pluto for ten years from JPL's DE421 positions, by Newton's gravitation alone."""
    bodies, names = _build_solar_system()
    ephemeris = read_table("solar_system_de421.csv")
    dates = ephemeris["julian_date_tdb"]
    position = _stack_places(ephemeris, dates == dates.max())
    # differences to Newton's law after ten years [km]: relativity, asteroids, the Moon as a separate body
    missing = {"mercury": 1823, "venus": 901, "earthmoon": 561, "mars": 341, "jupiter": 72.2, "saturn": 15.5}
    missing |= {"uranus": 0.38, "neptune": 0.155, "pluto": 0.24}
    known = np.array([name in missing for name in names])
    expected = np.array([missing[name] for name in names[known]])
    return Problem(
        bodies,
        duration=float((dates.max() - dates.min()) * DAY),
        conserved=CONSERVED,
        truths=(
            Truth(
                "after ten years, differs from DE421 by what Newton's law lacks, planet by planet [km]",
                lambda flight: np.linalg.norm(flight.position[-1] - position, axis=-1)[known] / 1e3,
                expected,
                0.05 * expected,
            ),
        ),
        frames=40,
    )


@scene
def solar_year() -> Problem:
    """A year of the solar system by Newton's gravitation, for methods that are good to a metre."""
    bodies, _ = _build_solar_system()
    position = read_newtonian_places(365.25)
    return Problem(
        bodies,
        duration=365.25 * DAY,
        conserved=CONSERVED,
        truths=(
            Truth(
                "after a year, where an integration in 34 digits leaves them [m]",
                lambda flight: np.linalg.norm(flight.position[-1] - position, axis=-1),
                0.0,
                1.0,
            ),
        ),
        frames=24,
    )


DAY = 86400.0


def read_newtonian_places(days: float) -> np.ndarray:
    """Where Newton's law takes the solar system in 365.25 or 3652.5 days [m], integrated in 34 digits."""
    table = read_table("solar_system_newton.csv")
    return _stack_places(table, table["days"] == days)


def _build_solar_system() -> tuple[Scene, np.ndarray]:
    """Sun, planets and Pluto where DE421 has them at J2000, and their names."""
    ephemeris = read_table("solar_system_de421.csv")
    dates = ephemeris["julian_date_tdb"]
    start = dates == dates.min()
    velocity = np.stack([ephemeris[c][start] for c in ("vx_m_s", "vy_m_s", "vz_m_s")], axis=-1)
    gm = ephemeris["gm_m3_s2"][start]
    state = Particles(jnp.asarray(_stack_places(ephemeris, start)), jnp.asarray(velocity))
    return Scene(state, mass=gm / 6.67430e-11, forces=(forces.Gravitation(gm=gm),)), ephemeris["body"][start]


def _stack_places(table: dict[str, np.ndarray], rows: np.ndarray) -> np.ndarray:
    return np.stack([table[c][rows] for c in ("x_m", "y_m", "z_m")], axis=-1)


def _solve_kepler(mean: np.ndarray, e: float) -> np.ndarray:
    """Solve Kepler's equation E - e sin E = M by Newton's method from E = π, which converges for every e < 1."""
    turns = np.floor(mean / (2 * np.pi))
    mean = mean - 2 * np.pi * turns
    anomaly = np.full_like(mean, np.pi)
    for _ in range(60):
        anomaly = anomaly - (anomaly - e * np.sin(anomaly) - mean) / (1 - e * np.cos(anomaly))
    return anomaly + 2 * np.pi * turns
