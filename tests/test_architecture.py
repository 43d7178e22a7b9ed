"""The house rules: imports point down, files stay short, names are documented, and a scene pays only for what it uses."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from collections import Counter, defaultdict
from graphlib import TopologicalSorter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import physjax
from physjax import Particles, Scene, forces, inertia, methods, rigid, simulate

ROOT = Path(physjax.__file__).parent
FILES = {path.relative_to(ROOT).as_posix(): path for path in sorted(ROOT.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in FILES.items()}

FLOORS = (
    {"name_hints"},
    {"backend", "tracebacks"},
    {
        "vectors",
        "checks",
        "files",
        "text",
        "timing",
        "loops",
        "linear",
        "closures",
        "lazy",
        "mesh_files",
        "old_names",
        "components",
        "programs",
        "custom_transpose",
        "xla_options",
    },
    {
        "roots",
        "cubics",
        "meshes",
        "projectile",
        "compiling",
        "compaction",
        "kernels",
        "memory",
        "stacks",
        "replays",
        "summaries",
    },
    {"particles", "quantities"},
    {"parts"},
    {"pins", "stages", "trials", "memory_masks"},
    {"scene"},
    {"memories", "first_order"},
    {"constraints", "select", "crossing", "moments", "run_files"},
    {"trajectory"},
    {"physics", "stepping"},
    {"show"},
    {"study"},
    {"scenes"},
    {"live"},
    {"cli"},
    {"__main__"},
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}


def room(file):
    """The part of the house a file is in: its folder, or its own name."""
    return Path(file).parts[0].removesuffix(".py")


def imports(tree, file):
    """Dotted names of all modules of physjax that a file imports, at its top or inside a function."""
    package = ["physjax", *Path(file).parts[:-1]]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, (base, node.module)))
            yield from (f"{module}.{alias.name}" for alias in node.names)


# the arrows


@pytest.mark.parametrize("file", [file for file in FILES if file != "__init__.py"])
def test_imports_only_point_down(file):
    assert room(file) in FLOOR, f"{file} is not on any floor of the house; say where it belongs"
    for name in imports(TREES[file], file):
        top, _, rest = name.partition(".")
        if top != "physjax":
            continue
        target = rest.partition(".")[0]
        assert target in FLOOR, f"{file} imports {name} through the front door; import from the module that defines it"
        assert target == room(file) or FLOOR[target] < FLOOR[room(file)], (
            f"{file} imports {name}, which is not below it"
        )


@pytest.mark.parametrize(
    ("file", "line", "found"),
    [
        ("physics/forces.py", "def f():\n    from physjax.stepping import methods", "physjax.stepping.methods"),
        ("physics/forces.py", "from ..stepping import methods", "physjax.stepping.methods"),
        ("physics/forces.py", "from . import gravitation", "physjax.physics.gravitation"),
        ("scene.py", "import physjax.study.energy as e", "physjax.study.energy"),
        ("scene.py", "from physjax import Particles", "physjax.Particles"),
    ],
)
def test_every_way_to_import_is_seen(file, line, found):
    assert list(imports(ast.parse(line), file)) == [found]


ALIASES = {"physics/fields.py", "physics/inertia.py", "physics/lattices.py", "physics/meshes.py", "scenes/gallery.py"}
"""Old names of modules that users import."""


def slices(top):
    """The arrows between the parts of a folder (its folders, and its own files), each with the imports it is made of."""
    arrows = defaultdict(list)
    for file, tree in TREES.items():
        parts = Path(file).with_suffix("").parts
        if parts[0] != top or parts[1] == "__init__" or file in ALIASES:
            continue
        for name in imports(tree, file):
            target = name.split(".")
            if target[:2] == ["physjax", top] and len(target) > 2 and target[2] != parts[1]:
                arrows[parts[1], target[2]].append(f"{file}: {name}")
    return dict(arrows)


def test_inside_physics_only_rigid_bodies_know_another_folder():
    assert set(slices("physics")) == {("rigid", "contacts")}


def test_the_slices_of_a_study_have_few_arrows_and_no_circle():
    arrows = slices("study")
    assert len(arrows) <= 14, sorted(arrows)
    TopologicalSorter({part: {to for start, to in arrows if start == part} for part, _ in arrows}).prepare()
    assert ("problem", "energy") in arrows


@pytest.mark.parametrize("file", sorted(ALIASES))
def test_an_alias_holds_what_its_new_module_holds(file):
    alias = importlib.import_module(f"physjax.{file[:-3].replace('/', '.')}")
    (new,) = {name.rpartition(".")[0] for name in imports(TREES[file], file)}
    assert alias.__all__ == importlib.import_module(new).__all__
    assert all(getattr(alias, name) is getattr(importlib.import_module(new), name) for name in alias.__all__)


# style


@pytest.mark.parametrize("file", FILES)
def test_no_file_is_over_400_lines(file):
    assert len(FILES[file].read_text(encoding="utf-8").splitlines()) <= 400


def documented_constants(tree):
    """Module-level numbers in capitals, each with whether a docstring behind it gives the reason."""
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name | ast.Tuple):
            names = [name.id for name in ast.walk(node.targets[0]) if isinstance(name, ast.Name)]
            numbers = [
                c.value for c in ast.walk(node.value) if isinstance(c, ast.Constant) and type(c.value) in (int, float)
            ]
            if names[0].isupper() and numbers:
                yield names, isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)


@pytest.mark.parametrize("file", [file for file in FILES if room(file) != "scenes"])
def test_every_number_that_is_named_has_its_reason_behind_it(file):
    assert [names for names, documented in documented_constants(TREES[file]) if not documented] == []


def public(node):
    return isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")


@pytest.mark.parametrize("file", FILES)
def test_every_public_name_is_documented(file):
    tree = TREES[file]
    names = [(file, tree)] + [(node.name, node) for node in tree.body if public(node)]
    for _, node in list(names):
        if isinstance(node, ast.ClassDef):
            names += [(f"{node.name}.{method.name}", method) for method in node.body if public(method)]
    assert [name for name, node in names if not ast.get_docstring(node)] == []


def test_every_exported_name_exists_and_is_documented():
    for file in FILES:
        if file.startswith("__main__"):
            continue
        module = importlib.import_module(
            ".".join(("physjax", *Path(file).with_suffix("").parts)).removesuffix(".__init__")
        )
        for name in getattr(module, "__all__", ()):
            assert inspect.getdoc(getattr(module, name)), f"{module.__name__}.{name}"
    assert {"Particles", "Scene", "Trajectory", "simulate", "reference", "forces", "methods", "loads"} <= set(
        physjax.__all__
    )


@pytest.mark.parametrize("name", physjax.__all__)
def test_tab_shows_what_is_ours_and_nothing_else(name):
    face = getattr(physjax, name)
    if inspect.ismodule(face):
        assert sorted(dir(face)) == sorted(face.__all__)
        assert not [item for item in dir(face) if item.startswith("_")]
        foreign = [item for item in dir(face) if inspect.ismodule(getattr(face, item))]
        assert all(getattr(face, item).__name__.startswith("physjax.") for item in foreign)


@pytest.mark.parametrize("file", [file for file in FILES if room(file) in {"physics", "stepping", "vectors"}])
def test_vectors_are_written_by_components_and_never_scattered(file):
    slow = {"einsum", "tensordot", "matmul", "vdot", "linalg"}
    # contacts that are solved one after the other, in whole rows of worlds, which are as fast as slices; and some worlds of many
    writes_rows = file in [f"physics/rigid/solids/{name}.py" for name in ("sweeps", "impacts", "links")]
    for node in ast.walk(TREES[file]):
        assert not (isinstance(node, ast.Attribute) and node.attr in slow), f"{file}:{node.lineno} {node.attr}"
        assert not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult)), f"{file}:{node.lineno} @"
        scatter = isinstance(node, ast.Subscript) and getattr(node.value, "attr", "") == "at"
        assert writes_rows or not scatter, f"{file}:{node.lineno} .at["


COMPILER_WORDS = (
    "default_backend",
    "optimization_barrier",
    "compiler_options",
    "process_time",
    "__version_info__",
    "platform",
)


@pytest.mark.parametrize("file", [file for file in FILES if file not in ("backend.py", "xla_options.py")])
def test_two_files_know_the_compiler_and_the_device(file):
    text = FILES[file].read_text(encoding="utf-8")
    # the folder of compiled programs has the processor in its name
    words = set(COMPILER_WORDS) - ({"platform"} if file == "compiling.py" else set())
    assert [word for word in words if word in text] == [], f"{file}: ask physjax.backend"


# a scene pays only for what it uses


def semi_implicit_euler(x, v, dt, a):
    v = v + dt * a(x, v)
    return x + dt * v, v


def verlet(x, v, dt, a):
    start = a(x, v)
    half = v + dt / 2 * start
    x = x + dt * half
    return x, half + dt / 2 * a(x, half + dt / 2 * start)


def rk4(x, v, dt, a):
    a1 = a(x, v)
    v2 = v + dt / 2 * a1
    a2 = a(x + dt / 2 * v, v2)
    v3 = v + dt / 2 * a2
    a3 = a(x + dt / 2 * v2, v3)
    v4 = v + dt * a3
    a4 = a(x + dt * v3, v4)
    return x + dt / 6 * (v + 2.0 * v2 + 2.0 * v3 + v4), v + dt / 6 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)


BY_HAND = pytest.mark.parametrize("by_hand", [semi_implicit_euler, verlet, rk4])
X, V, STEP = np.zeros((64, 2), np.float32), np.ones((64, 2), np.float32), np.float32(0.01)


def compiled(step, *arguments):
    """A step's compiled text, the count of each of its instructions (fused ones too), and its floating-point operations."""
    program = jax.jit(step).lower(*arguments).compile()
    text = program.as_text()
    operations = Counter(re.findall(r"^\s+(?:ROOT )?%?\S+ = .*? ([a-z][\w\-]*)\(", text, re.MULTILINE))
    return text, operations, program.cost_analysis()["flops"]


def compiled_scene(method, *parts, mass=1.0):
    scene = Scene(Particles(jnp.asarray(X), jnp.asarray(V)), mass=mass, forces=parts)
    return compiled(lambda scene, dt: scene.step(method, 0.0, dt).state, scene, STEP)


@BY_HAND
def test_a_scene_with_gravity_alone_compiles_to_the_hand_written_step(by_hand):
    def fall(x, v, dt, g):
        return by_hand(x, v, dt, lambda x, v: jnp.broadcast_to(-g * jnp.asarray([0.0, 1.0], np.float32), v.shape))

    text, operations, flops = compiled_scene(getattr(methods, by_hand.__name__), forces.Gravity())
    _, by_hand_operations, by_hand_flops = compiled(fall, X, V, STEP, np.float32(9.8))
    assert operations.total() <= by_hand_operations.total()
    assert flops <= by_hand_flops
    assert set(operations) <= set(by_hand_operations)
    assert not {"gather", "scatter", "sqrt", "rsqrt", "while", "select", "compare", "reduce", "call"} & set(operations)
    assert not re.search(r"f32\[(\d+,)*3\]|f64\[", text)


@BY_HAND
def test_a_scene_with_drag_compiles_to_the_hand_written_step_with_its_square_root(by_hand):
    def fly(x, v, dt, g, area, coefficient, density, mass):
        def acceleration(x, v):
            speed = jnp.sqrt(v[:, 0] * v[:, 0] + v[:, 1] * v[:, 1])
            drag = (-0.5 * density * coefficient * area * speed)[:, None] * v
            return jnp.broadcast_to(-g * jnp.asarray([0.0, 1.0], np.float32), v.shape) + 1.0 / mass * drag

        return by_hand(x, v, dt, acceleration)

    drag = forces.QuadraticDrag(area=0.1, coefficient=0.5)
    text, operations, flops = compiled_scene(getattr(methods, by_hand.__name__), forces.Gravity(), drag)
    numbers = np.asarray([9.8, 0.1, 0.5, 1.225, 1.0], np.float32)
    _, by_hand_operations, by_hand_flops = compiled(fly, X, V, STEP, *numbers)
    assert operations.total() <= by_hand_operations.total()
    assert flops <= by_hand_flops
    assert 0 < operations["sqrt"] <= by_hand_operations["sqrt"]
    assert not {"gather", "scatter", "while", "select", "compare"} & set(operations)
    assert not re.search(r"f32\[(\d+,)*3\]|f64\[", text)


def test_a_falling_body_never_looks_its_mass_up():
    def arguments(*parts):
        text, _, _ = compiled_scene(methods.verlet, *parts, mass=np.linspace(1, 2, 64))
        return re.search(r"^ENTRY .*$", text, re.MULTILINE)[0]

    assert "mass" not in arguments(forces.Gravity(), forces.RotatingFrame(1.0))
    assert "mass" in arguments(forces.Gravity(), forces.StokesDrag(1.0))


def test_a_whole_run_adds_the_loop_and_the_frames_and_nothing_else():
    scene = Scene(Particles(jnp.asarray(X), jnp.asarray(V)), forces=(forces.Gravity(),))
    run = lambda scene: simulate(scene, methods.rk4, dt=0.01, steps=64, save_every=8).state  # noqa: E731
    text, operations, _ = compiled(run, scene)
    assert 0 < operations["while"] <= 2
    assert not {"gather", "scatter", "sqrt", "conditional"} & set(operations)
    assert not re.search(r"f32\[(\d+,)*3\]|f64\[", text)


def test_particles_run_without_a_line_of_rigid_bodies():
    program = """
import sys
import jax.numpy as jnp
from physjax import Particles, Scene, energy, forces, methods, simulate
scene = Scene(Particles(jnp.zeros(3), jnp.ones(3)), forces=(forces.Gravity(),))
for method in methods.METHODS.values():
    simulate(scene, method, dt=0.1, steps=4)
energy.total(scene, 0.0, scene.state)
print(*(name for name in sys.modules if name.startswith("physjax.physics.")))
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert run.stdout.split()
    assert not [name for name in run.stdout.split() if name.startswith("physjax.physics.rigid")]


def test_a_free_body_compiles_to_its_quaternion_and_nothing_of_pivots_or_torques():
    brick = inertia.box(2.0, (1.0, 2.0, 3.0))
    lanes = np.zeros((64, 3), np.float32)
    with jax.enable_x64(False):
        scene = Scene(rigid.bodies(brick, lanes, angular_velocity=(1.0, 2.0, 3.0)), brick, (forces.Gravity(),))
        step = lambda scene, dt: scene.step(methods.rk4, 0.0, dt).state  # noqa: E731
        _, operations, _ = compiled(step, scene, STEP)
    assert not {"gather", "scatter", "sine", "cosine", "while", "reduce", "dot"} & set(operations)
    assert operations["multiply"] < 4 * 60  # I⁻¹ Rᵀ L, half of q ω and a slope are 3 + 18 + 16 + 13 products a stage


# import


def test_importing_brings_in_what_a_first_run_needs_and_nothing_else():
    """What it costs is measured in `benchmarks/throughput.py`; a clock in a test would measure the machine's other work."""
    program = "import jax, sys; before = set(sys.modules); import physjax; print(*set(sys.modules) - before)"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    loaded = run.stdout.split()
    needed = {"physjax", "equinox", "jaxtyping", "wadler_lindig", "typing_extensions", "jax", "numpy"}
    assert {name.split(".")[0] for name in loaded} - sys.stdlib_module_names <= needed
    later = ("physjax.study", "physjax.show", "physjax.scenes", "physjax.physics.rigid")
    assert not [name for name in loaded if name.startswith(later)]
