"""The ledger of a run: what every store and every cause received of its energy, momentum and angular momentum."""

from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from physjax.particles import callable_name
from physjax.scene import Scene, SubdividingMethod, project
from physjax.study.energy.audit import NUMERICAL, RESPONSE_OBSERVERS, EnergyBudget, audit_run, list_causes
from physjax.text import format_table
from physjax.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNITS = {"energy": "J", "momentum": "kg m/s", "angular momentum": "kg m²/s"}
FIRST_SUBSTEPS, MAX_SUBSTEPS = 2, 512
"""Steps of order 8 for one of the run, at first and at most."""
SUBSTEP_TOLERANCE = 1e-11
"""The exact motion is exact enough when twice the substeps change no entry by more than this share of the largest: some
thousand roundings in float64, which the sums over a run come to."""


class Account(NamedTuple):
    """What each store and each cause has `received` of one quantity since the start, frame by frame.

    `received[name]` is `(frames, *status)` in `unit`, with the components last for vectors; `status` is per lane, or per
    scene where lanes are coupled. Stores are "kinetic" and "potential of ..." (of a momentum: "scene"); everything else
    is a cause: a force has received what it took by its work (if it has a potential, only what that does not account
    for), a contact what an impact dissipated. A negative entry has given. All entries sum to zero, but for `gap`. `size`
    is the quantity's own scale: kinetic energy, Σm|v|, Σm|r||v|.
    """

    unit: str
    received: dict[str, np.ndarray]
    size: np.ndarray

    @property
    def totals(self) -> dict[str, np.ndarray]:
        """What each has received at the end."""
        return {name: series[-1] for name, series in self.received.items()}

    @property
    def gap(self) -> np.ndarray:
        """The sum of all entries, which would be zero in exact arithmetic, frame by frame."""
        first, *others = self.received.values()
        return sum(others, first)

    @property
    def closing(self) -> float:
        """The old name of `closure_error`."""
        return self.closure_error

    @property
    def closure_error(self) -> float:
        """The largest gap relative to the largest entry, or to the `size`: kinetic energy, Σm|v|, Σm|r||v|."""
        largest = max([float(np.abs(series).max()) for series in self.received.values()] + [float(self.size.max())])
        return float(np.abs(self.gap).max()) / largest if largest else 0.0


class Ledger(NamedTuple):
    """Where energy, momentum and angular momentum of a run went. Printed, it is a table of the totals over all lanes.

    `time` [s] is that of the frames. `angular_momentum`, about the origin, is None in one dimension. `substeps` of order
    8 followed the exact motion through each step; `substep_error` is by how much half as many would change an entry,
    relative to the largest.
    """

    time: np.ndarray
    method: str
    energy: Account
    momentum: Account
    angular_momentum: Account | None
    substeps: int
    substep_error: float

    @property
    def unsettled(self) -> float:
        """The old name of `substep_error`."""
        return self.substep_error

    @property
    def accounts(self) -> dict[str, Account]:
        """The accounts by the name of their quantity."""
        kept = {"energy": self.energy, "momentum": self.momentum, "angular momentum": self.angular_momentum}
        return {name: account for name, account in kept.items() if account is not None}

    def __repr__(self) -> str:
        """The totals that are printed."""
        return f"<Ledger: {self}>"

    def __str__(self) -> str:
        labels = list(dict.fromkeys(name for account in self.accounts.values() for name in account.received))
        headers, columns = ["received by", *(f"{name} [{a.unit}]" for name, a in self.accounts.items())], []
        for account in self.accounts.values():
            totals = account.totals | {"sum": account.gap[-1]}
            columns.append([_format_total(account, totals.get(label)) for label in (*labels, "sum")])
        rows = [[label, *cells] for label, *cells in zip((*labels, "sum"), *columns, strict=True)]
        span = f"{float(np.max(self.time[-1] - self.time[0])):.6g} s of {self.method}"
        return f"{span}; {NUMERICAL}: the method's own error\n{format_table(headers, rows)}"

    def plot(self, figure: "Figure | None" = None) -> "Figure":
        """Draw the energy over time and its totals; returns the matplotlib figure."""
        from physjax.study.energy.chart import draw_energy_budget

        return draw_energy_budget(self, figure)


def _format_total(account: Account, total: np.ndarray | None) -> str:
    """A total over all lanes, component by component."""
    if total is None:
        return ""
    parts = sum_lanes(account, total)
    return ", ".join(f"{part:.4g}" for part in np.atleast_1d(parts))


def sum_lanes(account: Account, amounts: np.ndarray) -> np.ndarray:
    """Amounts without the axis of frames, summed over all lanes; the components of a vector stay."""
    lanes = account.size.ndim - 1
    return amounts.sum(axis=tuple(range(lanes))) if lanes else amounts


def build_ledger(run: Trajectory, scene: Scene | None = None) -> Ledger:
    """See `energy.ledger`."""
    if not isinstance(run, Trajectory):
        raise TypeError(f"ledger: got a {type(run).__name__}, expected the Trajectory that simulate returns.")
    if scene is not None:
        run = eqx.tree_at(lambda run: run.scene, run, scene, is_leaf=lambda leaf: leaf is None)
    scene = _demand_audited_scene(run)
    with jax.enable_x64(True):
        stock, received, substeps, substep_error = _refine_substeps(run)
    return _build_accounts(run, scene, stock, received, substeps, substep_error)


def _demand_audited_scene(run: Trajectory) -> Scene:
    """The scene of a run that can be stepped again; a ValueError for one that cannot, or whose stages are not known."""
    if run.scene is None or run.stepper is None or run.state is None:
        raise ValueError(
            "ledger: got a run that does not know its scene, its method or its states. Give scene=, simulate without "
            "record=, and load with method=; a reference has no method whose error could be measured."
        )
    if run.scene.emitter is not None:
        raise ValueError(
            "ledger: got a scene with an emitter, expected one without: particles bring energy when they are born and take "
            "it when they die."
        )
    for contact in run.scene.contacts:
        if (contact.response or project) not in (*RESPONSE_OBSERVERS, project):
            raise ValueError(
                f"ledger: {type(contact).__name__} has a response of its own, expected one of physjax, whose stages are "
                "known."
            )
    if isinstance(run.stepper, SubdividingMethod) and run.scene.resolves_at_step_end:
        raise ValueError(
            "ledger: got steps under error control, at the ends of which contacts are projected or springs break, expected equal "
            "ones, whose stages can be seen. Run with a method of its own, such as methods.rk4 with a small dt."
        )
    return run.scene


def _refine_substeps(run: Trajectory) -> tuple[EnergyBudget, EnergyBudget, int, float]:
    """The stock and the budget with substeps doubled until the entries no longer change."""
    substeps = FIRST_SUBSTEPS
    stock, before = _audit_with_substeps(run, substeps)
    while True:
        substeps *= 2
        _, brought = _audit_with_substeps(run, substeps)
        change = max(_largest_change(before, brought, stock, name) for name in stock["amounts"])
        if not change > SUBSTEP_TOLERANCE or substeps >= MAX_SUBSTEPS:
            return stock, brought, substeps, change
        before = brought


def _audit_with_substeps(run: Trajectory, substeps: int) -> tuple[EnergyBudget, EnergyBudget]:
    return jax.tree.map(np.asarray, audit_run(run, jnp.asarray(substeps)))


def _largest_change(before: EnergyBudget, brought: EnergyBudget, stock: EnergyBudget, name: str) -> float:
    """The largest change of an entry relative to the largest that the quantity has."""
    largest = np.abs(stock["amounts"][name] - stock["amounts"][name][:1]).max()
    sums = lambda budget, cause: np.cumsum(budget[cause][name], axis=0)  # noqa: E731
    largest = max([largest, stock["sizes"][name].max()] + [np.abs(sums(brought, cause)).max() for cause in brought])
    change = max(np.abs(sums(brought, cause) - sums(before, cause)).max() for cause in brought)
    return float(change / largest) if largest else 0.0


def _build_accounts(
    run: Trajectory, scene: Scene, stock: EnergyBudget, brought: EnergyBudget, substeps: int, substep_error: float
) -> Ledger:
    """The accounts, summed up frame by frame; a run that came out of vmap has its axis behind that of the frames."""
    batched = run.first_step.ndim
    frames_first = lambda series: np.moveaxis(series, batched, 0) if batched else series  # noqa: E731
    stock, brought = (jax.tree.map(frames_first, budget) for budget in (stock, brought))
    gained = lambda series: series - series[:1]  # noqa: E731
    accounts = {}
    for name, amount in stock["amounts"].items():
        stores = stock["stored"] if name == "energy" else {"scene": amount}
        received = {store: gained(series) for store, series in stores.items()}
        for cause in (label for labels in list_causes(scene) for label in labels):
            total = np.cumsum(brought[cause][name], axis=0)
            received[cause] = -np.concatenate([np.zeros_like(total[:1]), total])
        silent = {cause for cause in received if name == "energy" and f"potential of {cause}" in received}
        largest = max(np.abs(series).max() for series in received.values())
        received = {
            n: s for n, s in received.items() if n not in silent or np.abs(s).max() > SUBSTEP_TOLERANCE * largest
        }
        accounts[name] = Account(UNITS[name], received, stock["sizes"][name])
    return Ledger(
        np.asarray(frames_first(np.asarray(run.time, float))),
        callable_name(run.method),
        accounts["energy"],
        accounts["momentum"],
        accounts.get("angular momentum"),
        substeps,
        substep_error,
    )
