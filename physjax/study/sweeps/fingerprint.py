"""What a compiled program calls on the host, and an identity for such a function that holds in another process.

A program refers to a callback by a number alone. Its function is hashed instead: bytecode, constants, defaults, what it
closes over and the globals it reads, recursively. What cannot be followed to the end (an object's methods, a file, a
module of the user's, a random generator) has no lasting identity, and is refused with the reason.
"""

import builtins
import dis
import functools
import hashlib
import sys
import types
from collections.abc import Collection, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

HostCall = tuple[str, object]
"""The kind of a call from a compiled program to the host, and what is called."""
_CALL_PRIMITIVES = {"pure_callback", "io_callback", "debug_callback", "debug_print", "ffi_call"}
_LIBRARIES = {"numpy", "scipy", "jax", "jaxlib", "math", "cmath", "operator", "functools", "itertools", "builtins"}
"""Packages whose functions do the same wherever their version is the same."""
_PURE_BUILTIN_WORDS = (
    "abs all any bool bytes complex dict divmod enumerate filter float frozenset int isinstance len list map max min pow "
    "print range reversed round set slice sorted str sum tuple zip Exception ArithmeticError AssertionError IndexError "
    "FloatingPointError KeyError OverflowError RuntimeError TypeError ValueError ZeroDivisionError"
)
_UNREPEATABLE_WORDS = (
    "random rand randn randint default_rng seed load loadtxt genfromtxt fromfile memmap open open_memmap DataSource io "
    "lib ctypeslib f2py environ __dict__ __globals__ __import__ import_module"
)
_PURE_BUILTINS = frozenset(_PURE_BUILTIN_WORDS.split())
_UNREPEATABLE = frozenset(_UNREPEATABLE_WORDS.split())
"""Names in those packages that lead to files, random generators, or what cannot be followed."""


def list_inner_jaxprs(equation: JaxprEqn) -> list[Jaxpr]:
    """The programs that an operation runs: bodies of loops, branches, functions."""
    found = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda p: isinstance(p, Jaxpr | ClosedJaxpr))
    return [p.jaxpr if isinstance(p, ClosedJaxpr) else p for p in found if isinstance(p, Jaxpr | ClosedJaxpr)]


def find_host_calls(jaxpr: Jaxpr) -> list[HostCall]:
    """Everything that a program calls on the host: its kind, with the function (or the printed format, or the name)."""
    found = []
    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        if name in _CALL_PRIMITIVES:
            called = params.get("callback", params.get("fmt", params.get("target_name")))
            returns = name == "pure_callback" or (name == "io_callback" and equation.outvars)
            kind = name if returns or name == "ffi_call" else "message"
            found.append((kind, getattr(called, "callback_func", called)))
        found += [call for body in list_inner_jaxprs(equation) for call in find_host_calls(body)]
    return found


def persistent_digest(digest: str, calls: tuple[HostCall, ...]) -> str:
    """The hash of a program together with the Python functions it calls back; ValueError where one has no identity."""
    results = [(kind, called) for kind, called in calls if kind != "message"]
    if not results:
        return digest
    found = hashlib.sha256(digest.encode())
    for kind, called in results:
        if kind == "ffi_call":
            raise ValueError(_refusal_text(f"it calls the compiled code of {called!r} through jax.ffi"))
        if kind == "unknown":
            raise ValueError(_refusal_text("it calls Python in a way that is not known here"))
        if kind == "io_callback":
            raise ValueError(
                _refusal_text(f"its io_callback to {_callable_name(called)} may return something else each time")
            )
        try:
            for part in _walk_value(called, []):
                found.update(len(part).to_bytes(8, "big") + part)
        except UnknownDependency as error:
            raise ValueError(_refusal_text(f"its callback {_callable_name(called)} depends on {error}")) from error
    return found.hexdigest()


class UnknownDependency(Exception):
    """A dependency of a function that has no lasting identity."""


def _refusal_text(reason: str) -> str:
    return (
        f"sweep: got out= with a measure that calls out of its program, and {reason}: a folder could not tell it from another "
        "one. Expected a measure in jnp, or a pure_callback to a function of numbers, arrays and functions of NumPy and "
        "SciPy. Leave out= away and keep the results with .save, or write that part in jnp."
    )


def _callable_name(called: object) -> str:
    return getattr(called, "__qualname__", type(called).__name__)


def _walk_value(value: Any, seen: list[object]) -> Iterator[bytes]:
    """Bytes that are the same for two values only if they do the same; UnknownDependency for what cannot be followed."""
    kind = type(value)
    if any(value is other for other in seen):
        yield f"again {[value is other for other in seen].index(True)}".encode()
    elif value is None or value is Ellipsis or kind in (bool, int, float, complex, str, bytes):
        yield f"{kind.__name__} {value!r}".encode()
    elif isinstance(value, jax.Array) or kind is np.ndarray or isinstance(value, np.generic):
        yield from _walk_array(value)
    elif isinstance(value, np.dtype):
        yield f"dtype {value!r}".encode()
    elif kind in (tuple, list, dict, set, frozenset):
        yield from _walk_collection(value, seen)
    elif isinstance(value, types.ModuleType):
        yield _module_version(value.__name__).encode()
    elif (name := _library_name(value)) is not None:
        yield name.encode()
    elif kind is functools.partial:
        seen.append(value)
        yield from _walk_values(("partial", value.func, value.args, value.keywords), seen)
    elif kind is types.MethodType:
        yield from _walk_values(("method", value.__func__, value.__self__), seen)
    elif kind is types.FunctionType:
        seen.append(value)
        yield from _walk_function(value, seen)
    elif kind is types.CodeType:
        yield from _walk_code(value, seen)
    else:
        raise UnknownDependency(f"an object of type {kind.__module__}.{kind.__qualname__}")


def _walk_values(values: Iterable[object], seen: list[object]) -> Iterator[bytes]:
    for value in values:
        yield from _walk_value(value, seen)


def _walk_array(value: jax.Array | np.ndarray | np.generic) -> Iterator[bytes]:
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        yield str(jax.random.key_impl(value)).encode()
        value = jax.random.key_data(value)
    array = np.asarray(value)
    if array.dtype.hasobject:
        raise UnknownDependency("an array of objects")
    yield f"{type(value) is np.ndarray} {array.dtype!r} {array.shape}".encode()
    yield np.ascontiguousarray(array).tobytes()


def _walk_collection(value: Collection[object], seen: list[object]) -> Iterator[bytes]:
    yield f"{type(value).__name__} {len(value)}".encode()
    if isinstance(value, set | frozenset):  # unordered: each by its own hash
        digests = []
        for one in value:
            found = hashlib.sha256()
            for part in _walk_value(one, list(seen)):
                found.update(len(part).to_bytes(8, "big") + part)
            digests.append(found.digest())
        yield from sorted(digests)
        return
    seen.append(value)
    yield from _walk_values(value.items() if isinstance(value, dict) else value, seen)


def _walk_function(function: types.FunctionType, seen: list[object]) -> Iterator[bytes]:
    """Code, defaults, attributes, what it closes over, and the globals that its code reads."""
    yield f"function, Python {sys.version_info[:2]}".encode()
    try:
        closed = tuple(cell.cell_contents for cell in function.__closure__ or ())
    except ValueError as error:
        raise UnknownDependency("a variable that has no value yet") from error
    yield from _walk_value(function.__code__, seen)
    yield from _walk_values((function.__defaults__, function.__kwdefaults__, dict(vars(function)), closed), seen)
    for name in sorted(_find_globals(function.__code__)):
        yield name.encode()
        if name in function.__globals__:
            yield from _walk_value(function.__globals__[name], seen)
        elif name not in _PURE_BUILTINS or not hasattr(builtins, name):
            raise UnknownDependency(f"{name!r}")


def _find_globals(code: types.CodeType) -> set[str]:
    """The globals that code and the functions in it read; UnknownDependency for what changes one, or imports one."""
    names = set()
    for step in dis.get_instructions(code):
        if step.opname == "IMPORT_NAME":
            _module_version(step.argval)
        elif step.opname in ("STORE_GLOBAL", "DELETE_GLOBAL"):
            raise UnknownDependency(f"the global {step.argval!r}, which it changes")
        elif step.opname == "LOAD_BUILD_CLASS":
            raise UnknownDependency("a class of its own")
        elif step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            names.add(step.argval)
    if hidden := sorted(set(code.co_names) & _UNREPEATABLE):
        raise UnknownDependency(f"{hidden[0]!r}")
    return names.union(*(_find_globals(part) for part in code.co_consts if isinstance(part, types.CodeType)))


def _walk_code(code: types.CodeType, seen: list[object]) -> Iterator[bytes]:
    """What is computed, without its place in a file and its name."""
    yield code.co_code
    yield code.co_exceptiontable
    counts = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
    names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    yield repr((counts, names)).encode()
    yield from _walk_values(code.co_consts, seen)


def _library_name(value: object) -> str | None:
    """The full name of a library's own function or type, with its version; None for anything else."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", getattr(value, "__name__", ""))
    if isinstance(value, types.BuiltinFunctionType) and isinstance(value.__self__, types.ModuleType):
        module = value.__self__.__name__
    if isinstance(value, np.ufunc):  # of no module before NumPy 2.3
        special = sys.modules.get("scipy.special")
        module = next((m.__name__ for m in (np, special) if m and getattr(m, value.__name__, None) is value), None)
        name = value.__name__
    if not isinstance(module, str) or module.partition(".")[0] not in _LIBRARIES:
        return None
    found = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is not value:
        return None
    if not _UNREPEATABLE.isdisjoint({*module.split("."), *name.split(".")}) or (
        module == "builtins" and name not in _PURE_BUILTINS
    ):
        raise UnknownDependency(f"{module}.{name}")
    return f"{_module_version(module)} {name}"


def _module_version(module: str) -> str:
    """A library's module with its version; UnknownDependency for a user's own, and for one that reads files or draws numbers."""
    top = module.partition(".")[0]
    if top not in _LIBRARIES or not _UNREPEATABLE.isdisjoint(module.split(".")):
        raise UnknownDependency(f"the module {module}")
    try:
        return f"{module} {version(top)}"
    except PackageNotFoundError:  # the standard library's
        return f"{module} {sys.version_info[:3]}"
