"""Does `recommend` meet the errors it promises, is its choice the fastest, and how does that compare with diffrax?

    python benchmarks/advisor.py --part promises --scenes kepler random:0 random:1
    python benchmarks/advisor.py --part rivals
    python benchmarks/advisor.py --part report

Each scene is written as soon as it is done, and what is written is not run again, so that a run can be interrupted and
resumed; `--limit` seconds end it. `--part report` judges and draws what there is.

Promises: on every scene of the gallery and 40 random ones, one search serves three errors; each recommended run is made
by `.simulate()` and judged by a reference solution other than the search's (a closed form; our own rk4 where the search
had diffrax; verlet where it had our rk4), and timed in turn with the fastest run of an exhaustive search, steps √2
apart: of every method that suits them and the best under error control on smooth scenes; of what the search would try
first where there are contacts, which take long to compile. Rivals: smooth scenes, 1000 copies whose velocities differ
by a percent; diffrax's solvers under vmap, each at the loosest of its tolerances, a power of ten apart, that meets the
error (Kvaerno5 only on small scenes; a tenth or twentieth of the duration where a run would take minutes).
"""

import json
import sys
import time
from functools import partial
from pathlib import Path

import harness
import jax
import jax.numpy as jnp
import numpy as np
from harness import Bar, print_progress

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from random_scenes import random_scene

from physjax import methods
from physjax.scenes import SCENES
from physjax.stepping.reference import cast_floats, discontinuities, ode_term
from physjax.study.accuracy import error_measures, list_compared_methods, recommend
from physjax.study.accuracy.compiled_run import compile_run, stack_copies
from physjax.study.accuracy.exploring import list_candidates
from physjax.study.accuracy.method_facts import smallest_size
from physjax.study.accuracy.reference_solution import solve_reference
from physjax.study.accuracy.search import SearchTask, explore_method, time_finalists
from physjax.study.problem import Problem
from physjax.timing import time_repeatedly

ERRORS = (1e-2, 1e-4, 1e-6)
RIVAL_ERRORS = (*ERRORS, 1e-8, 1e-10)
"""Against diffrax smaller errors are asked for as well, as far as the truth is known."""
RANDOM_SCENES = 40
BATCH = 1000
SOLVERS = ("Tsit5", "Dopri5", "Dopri8", "Kvaerno5")
ALLOWED_TIME_RATIO = 1.5
KVAERNO_STATE_LIMIT = 20
"""Numbers in a state beyond which Kvaerno5 is left out: its thousand dense solves a step take minutes to hours a run."""
SLOW_RUN_SECONDS = 15.0
"""Seconds of a rival's run that end its refinement."""
DURATION_SHARES = {"solar_system": 0.05, "hanging_rope": 0.1, "flag": 0.1, "hanging_cloth": 0.1}
"""Of the duration, for scenes whose thousand copies would otherwise take every solver minutes a run."""


def build_problem(name):
    """A scene of the gallery, or `random:SEED`."""
    with jax.enable_x64(True):
        kind, _, seed = name.partition(":")
        return Problem(*random_scene(int(seed))) if kind == "random" else SCENES[name]()


def check_promises(name):
    """One search for three errors, its errors checked, its runs against the fastest of an exhaustive search."""
    problem = build_problem(name)
    started, busy = time.perf_counter(), time.process_time()
    answers = recommend(problem.scene, error=ERRORS, horizon=problem.duration, frames=problem.frames, progress=False)
    seconds, busy = time.perf_counter() - started, time.process_time() - busy
    with jax.enable_x64(True):
        second = methods.rk4 if problem.is_ode else methods.verlet
        other = solve_reference(problem, wanted=1e-7, seconds=6.0, own=None if problem.exact is not None else second)
        truth_error = float(other.truth_error().max())
        runs = search_exhaustively(problem, answers)
        rows = [judge_promise(problem, other, truth_error, advice, runs) for advice in answers]
    return {
        "seconds": seconds,
        "busy": busy,
        "truth": answers[0].truth,
        "other": other.source,
        "doubt": truth_error,
        "answers": rows,
    }


def search_exhaustively(problem, answers):
    """(contender, run) of every method in float64, √2 apart."""
    entries = list_compared_methods(problem.scene) if problem.is_ode else list_candidates(problem.scene)[:3]
    slowest = max((a.best.seconds * problem.duration for a in answers if a.ok), default=0.1)
    truth = solve_reference(problem._replace(exact=None), wanted=min(ERRORS))
    task = SearchTask(problem, truth, error_measures.path, None, None, time.process_time() + 30)
    runs = []
    for method in entries:
        entry = compile_run(problem, method)
        for start in (1.0,) if entry.adaptive else (1.0, np.sqrt(2.0)):
            trials = explore_method(task, entry, min(ERRORS), (), start, longest=4 * slowest).trials
            runs += [(entry, trial) for trial in trials]
    return runs


def judge_promise(problem, other, truth_error, advice, runs):
    """A promised error, met or not, and the run's time relative to the fastest run that meets the same error."""
    row = {"error": advice.error, "ok": advice.ok, "reason": advice.reason, "evidence": advice.evidence}
    if not advice.ok:
        return row
    best = advice.best
    found = error_measures.path.error(other.scene, other.times, advice.simulate().state, other.states)
    row |= {"method": best.name, "dtype": best.dtype, "step": best.step, "promised": best.error, "found": found}
    row |= {"checked": truth_error < 0.2 * advice.error, "kept": bool(found <= advice.error + truth_error)}
    good = [(entry, trial) for entry, trial in runs if trial.error <= advice.error]
    if good:
        mine = compile_run(problem, best.method, best.dtype)
        fineness = 1 / best.tolerance if best.tolerance else float(best.steps_per_frame)
        # the few that look fastest are timed in turn: a single timing may have met a quiet moment
        few = sorted(good, key=lambda pair: pair[1].seconds)[:3]
        turns = [(mine, good[0][1]._replace(fineness=fineness)), *few]
        own, *others = time_finalists([(entry, trial._replace(seconds=np.inf)) for entry, trial in turns])
        fastest = int(np.argmin(others))
        row |= {"ratio": own / others[fastest], "fastest": few[fastest][0].name}
        row["its_step"] = few[fastest][0].dt(few[fastest][1].fineness)
    return row


def perturb_copies(scene, count):
    """`count` copies of a scene, their velocities (of bodies, momenta) changed by a percent at random."""
    rng = np.random.default_rng(0)
    many = stack_copies(scene, count)
    noise = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)) * jnp.abs(leaf), many.state)
    return many.replace(state=scene.kick(many.state, noise, 0.01))


def compare_rivals(name):
    """A thousand copies: the recommended run and diffrax's solvers at equal errors."""
    problem = build_problem(name)
    with jax.enable_x64(True):
        single = cast_floats(problem.scene, jnp.float64)
        duration = DURATION_SHARES.get(name, 1.0) * problem.duration
        many = problem._replace(scene=perturb_copies(single, BATCH), duration=duration, exact=None)
        asked = {"error": RIVAL_ERRORS, "horizon": many.duration, "frames": many.frames}
        answers = recommend(many.scene, seconds=120, progress=False, **asked)
        # a reference other than the search's, where that is diffrax's
        truth = solve_reference(many, wanted=min(RIVAL_ERRORS), seconds=60.0, own=methods.dopri8)
        numbers = sum(leaf.size for leaf in jax.tree.leaves(single.state))
        solvers = SOLVERS if numbers <= KVAERNO_STATE_LIMIT else SOLVERS[:-1]
        found = [run for solver in solvers for run in time_rival(single, many, truth, solver)]
    rows = []
    for advice in answers:
        good = [run for run in found if run["error"] <= advice.error]
        best = min(good, key=lambda run: run["seconds"], default=None)
        row = {"error": advice.error, "reason": advice.reason}
        if advice.ok:
            row |= {
                "ours": advice.best.name,
                "dtype": advice.best.dtype,
                "seconds": advice.best.seconds * many.duration,
            }
        if best:
            row |= {"diffrax": best["solver"], "its_seconds": best["seconds"]}
        rows.append(row | ({"times": row["its_seconds"] / row["seconds"]} if advice.ok and best else {}))
    return {"lanes": list(many.scene.state.lanes), "duration": duration, "rows": rows, "runs": found}


@partial(jax.jit, static_argnames=("solver", "frames"))
def solve_copies(scene, states, end, tol, size, solver, frames):
    """Every copy solved separately, with its own steps."""
    import diffrax

    controller = diffrax.PIDController(rtol=tol, atol=tol * size)
    jumps = discontinuities(scene)
    if jumps.size:
        controller = diffrax.ClipStepSizeController(controller, jump_ts=jumps)

    def one(state):
        return diffrax.diffeqsolve(
            ode_term(scene),
            getattr(diffrax, solver)(),
            t0=0.0,
            t1=end,
            dt0=None,
            y0=state,
            saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, end, frames + 1)),
            stepsize_controller=controller,
            adjoint=diffrax.ForwardMode(),
            max_steps=20_000,
            throw=False,
        ).ys

    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), jax.vmap(one)(states))


def time_rival(single, many, truth, solver):
    """Error and least time of a solver at tolerances a power of ten apart."""
    runs = []
    for tol in 10.0 ** -np.arange(2, 14):
        size = smallest_size(single)
        run = partial(solve_copies, single, many.scene.state, many.duration, tol, size, solver, many.frames)
        states, timing = time_repeatedly(run, 3, longest=SLOW_RUN_SECONDS)
        states, seconds = jax.tree.map(np.asarray, states), timing.least
        error = error_measures.path.error(truth.scene, truth.times, states, truth.states)
        if not np.isfinite(error):
            continue  # too loose to converge within the steps: a tighter tolerance may, and be faster
        runs.append({"solver": solver, "tolerance": tol, "error": error, "seconds": seconds})
        if seconds > SLOW_RUN_SECONDS or error < min(RIVAL_ERRORS):
            break
    return runs


def report(record, folder, quick):
    """Judge what there is, print it and draw it."""
    answers = [(name, row) for name, r in record["promises"].items() for row in r["answers"]]
    kept = [(name, row) for name, row in answers if row["ok"]]
    checked = [row["kept"] for _, row in kept if row["checked"]]
    ratios = [row["ratio"] for _, row in kept if "ratio" in row]
    against = [(name, row) for name, r in record["rivals"].items() for row in r["rows"] if "times" in row]
    raced = [row.get("times", 0.0) for r in record["rivals"].values() for row in r["rows"] if "diffrax" in row]
    searches = [r["busy"] for r in record["promises"].values()]
    bars = [
        Bar("promises kept, of those checked", float(np.mean(checked or [np.nan])), ">=", 0.98),
        Bar(
            "recommended within 1.5x of the fastest",
            float(np.mean(np.array(ratios or [np.nan]) <= ALLOWED_TIME_RATIO)),
            ">=",
            0.9,
        ),
        Bar("longest search [s of processor time]", max(searches, default=np.nan), "<=", 20.0),
        # where ours has no answer and diffrax has one, it is slower
        Bar("at least as fast as diffrax", float(np.mean(np.array(raced or [np.nan]) >= 1)), ">=", 1.0),
    ]
    label = lambda name, row: f"{name}, {row['error']:g}"  # noqa: E731
    rows = [
        [label(n, r), f"{r['method']} {r['dtype']}", r["step"], r["promised"], r["found"], r.get("ratio", np.nan)]
        for n, r in kept
    ]
    harness.print_table("promises", ["", "run", "step", "promised", "found", "time / fastest"], rows)
    rows = [
        [
            label(label_scene(n), r),
            f"{r['ours']} {r['dtype']}",
            r["seconds"],
            r["diffrax"],
            r["its_seconds"],
            r["times"],
        ]
        for n, r in against
    ]
    harness.print_table(f"{BATCH} copies", ["", "ours", "[s]", "diffrax", "[s]", "times faster"], rows)
    stopped = [f"{label(n, r)}: {r['reason']}" for n, r in answers if not r["ok"]]
    print("\nNothing meets the error:", *(stopped or ["-"]), sep="\n  ")
    scenes, smooth = len(SCENES) + RANDOM_SCENES, sum(build_problem(name).is_ode for name in SCENES)
    whole = [len(searches) == scenes] * 3 + [len(record["rivals"]) == smooth]
    done = f"{len(searches)} of {scenes} scenes, {len(record['rivals'])} of {smooth} against diffrax"
    print(f"\nDone so far: {done}. {'' if all(whole) else 'Bars of incomplete parts are not judged.'}")
    for judged in (True, False):
        if some := [bar for bar, all_ in zip(bars, whole, strict=True) if all_ == judged]:
            harness.print_bars(some, quick or not judged)
    record["bars"] = [bar._asdict() | {"met": bar.met if all_ else None} for bar, all_ in zip(bars, whole, strict=True)]
    record["counted"] = {"done": done, "answers": len(answers), "stopped": len(stopped)}
    record["counted"] |= {"checked": len(checked), "timed": len(ratios), "against_diffrax": len(against)}
    if against:
        foot = f"{harness.format_caption(record['machine'])}; {done}"
        silent = [name for name, r in record["rivals"].items() if not any("times" in row for row in r["rows"])]
        draw(harness.result_path(folder, "advisor", quick, "png"), kept, against, silent, foot)


def label_scene(name):
    """A scene's name, and how much of its duration its copies are run for where that is not all."""
    return name.replace("_", " ") + (f" ({DURATION_SHARES[name]:g} of it)" if name in DURATION_SHARES else "")


def draw(path, kept, against, silent, foot):
    """Promised against measured errors; times relative to the fastest; times relative to diffrax."""
    from matplotlib.figure import Figure

    from physjax.files import write_atomically

    figure = Figure(figsize=(13, 5.4), layout="constrained")
    promise, ratio, rival = figure.subplots(1, 3)
    colours = dict(zip(RIVAL_ERRORS, ("#D55E00", "#009E73", "#0072B2", "#56B4E9", "#CC79A7"), strict=True))
    names = list(dict.fromkeys([*silent, *(name for name, _ in against)]))
    for error, colour in colours.items():
        mine = [row for _, row in kept if row["error"] == error]
        seen = [(r["promised"] / error, r["found"] / error) for r in mine if r["checked"]]
        promise.plot(*np.maximum(np.array(seen).reshape(-1, 2), 1e-9).T, "o", color=colour, label=f"error {error:g}")
        ratios = sorted(r["ratio"] for r in mine if "ratio" in r)
        ratio.plot(np.linspace(0, 1, len(ratios)), ratios, color=colour)
        times = [(r["times"], names.index(name)) for name, r in against if r["error"] == error]
        rival.plot(*np.array(times).reshape(-1, 2).T, "o", color=colour)
    for line, ax in ((1.0, promise), (ALLOWED_TIME_RATIO, ratio)):
        ax.axhline(line, color="0.3", linestyle="--", linewidth=1)
    rival.axvline(1.0, color="0.3", linestyle="--", linewidth=1)
    promise.set(xlabel="error promised [asked for]", ylabel="error by another reference [asked for]", xscale="log")
    promise.set_title("promises: met on or below the line")
    ratio.set(xlabel="share of answers", ylabel="time [that of the fastest]", xlim=(0, 1))
    ratio.set_title("against an exhaustive search")
    rival.set(xlabel=f"time of diffrax's best [ours], {BATCH} copies", xscale="log")
    rival.set_yticks(range(len(names)), [label_scene(name) for name in names], fontsize=8)
    rival.plot(
        [0.02] * len(silent), [names.index(n) for n in silent], "x", color="0.2", transform=rival.get_yaxis_transform()
    )
    rival.set_title("right: ours is faster; x: no answer")
    promise.set_yscale("log")
    ratio.set_ylim(bottom=0)
    for ax in (promise, ratio, rival):
        ax.grid(color="0.92")
    promise.legend(frameon=False, fontsize=9)
    figure.supxlabel(foot, fontsize=8, x=0.01, ha="left")
    with write_atomically(path, "wb") as file:
        figure.savefig(file, format="png", dpi=110)


def main():
    """Run what is not done yet, scene by scene, until the limit; then report."""
    parser = harness.build_parser(__doc__)
    parser.add_argument("--part", choices=("promises", "rivals", "report"), default="report")
    parser.add_argument("--scenes", nargs="*", help="names of the gallery, random:SEED; all by default")
    parser.add_argument("--limit", type=float, default=480.0, help="seconds after which no scene is started")
    given = harness.parse_arguments(parser)
    path = harness.result_path(given.out, "advisor", given.quick, "json")
    record = json.loads(path.read_text()) if path.exists() else {"benchmark": "advisor", "promises": {}, "rivals": {}}
    started = time.perf_counter()
    work = {"promises": check_promises, "rivals": compare_rivals}
    chosen = given.scenes or [*SCENES, *(f"random:{seed}" for seed in range(RANDOM_SCENES) if given.part == "promises")]
    for name in chosen if given.part in work else ():
        if name in record[given.part] or time.perf_counter() - started > given.limit:
            continue
        if given.part == "rivals" and not build_problem(name).is_ode:
            continue
        begun = time.perf_counter()
        record[given.part][name] = work[given.part](name)
        record["machine"] = harness.describe_machine()
        print_progress(f"{name}: {time.perf_counter() - begun:.0f} s")
        harness.write_json(path, record)
        jax.clear_caches()
    if record["promises"]:
        report(record, given.out, given.quick)
        harness.write_json(path, record)
        print(f"\nwritten: {path}")


if __name__ == "__main__":
    main()
