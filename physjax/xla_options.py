"""What the compiler is asked for: options of a program, and one of the process."""

import functools
import os
import warnings
from collections.abc import Callable, MutableMapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from physjax.backend import Device, device_kind

T = TypeVar("T")
"""What a program returns."""
WIDE_VECTOR_OPTIONS = {"xla_cpu_prefer_vector_width": 512}
"""XLA fills half of an AVX-512 register unless asked for more, which makes a step 1.4 to 1.5 times faster."""
OLDER_EMITTER_OPTIONS = {"xla_cpu_use_fusion_emitters": False}
"""Timed contacts are many small kernels, over which the emitters of jax 0.10 take twice the compile time of the older ones.

From jax 0.11 on there are no others, and the option is gone.
"""
LOOP_EMITTER_FLAG = "--xla_backend_extra_options=xla_cpu_disable_tiled_emitter"
"""jax 0.10 may compute a sum of two `(lanes, 3)` arrays row by row through the stack, 58 µs for 4096 lanes, 1 µs without.

Derivatives are full of such sums: pushed through 200 steps of 32 768 flights they take 65 ms, and 8 without; pulled back
through bounces 540 and 420. No program can be given this option, only a process.
"""
COMMAND_BUFFER_OPTIONS = {
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUSTOM_CALL,WHILE,CONDITIONAL", "xla_gpu_graph_min_graph_size": 1
}  # fmt: skip
"""Loops and branches are recorded with the kernels in them, so that a card goes through them without asking the host.

On an H200 a bounce of one ball takes half the time (270 to 125 µs a step), a car's step 0.63 of it (710 to 445 µs).
"""


def ask_for_loop_emitter(environment: MutableMapping[str, str] = os.environ) -> None:
    """Add `LOOP_EMITTER_FLAG` to the variable XLA_FLAGS, unless it has such options already; in vain once JAX has computed."""
    flags = environment.get("XLA_FLAGS", "")
    option, _, _ = LOOP_EMITTER_FLAG.partition("=")
    if jax.__version_info__ < (0, 11) and option not in flags:
        environment["XLA_FLAGS"] = f"{flags} {LOOP_EMITTER_FLAG}".strip()


def jit_untransformed(
    function: Callable[..., T], device: Device | None = None, *, many_small_kernels: bool = False, **options: Any
) -> Callable[..., T]:
    """`jax.jit(function, **options)` with what makes a program fast on a device, the default one unless given.

    For functions that no `jit`, `vmap` or `grad` is around: XLA's options belong to a whole program, and JAX refuses
    them inside of another. An option that the installed compiler does not know is left out with a warning.
    `many_small_kernels` asks for what compiles those sooner.
    """
    kind = device_kind() if device is None else device.platform
    wanted: dict[str, int | bool | str] = {"cpu": WIDE_VECTOR_OPTIONS, "gpu": COMMAND_BUFFER_OPTIONS}.get(kind, {})
    if kind == "cpu" and many_small_kernels and jax.__version_info__ < (0, 11):
        wanted = wanted | OLDER_EMITTER_OPTIONS
    known = {name: value for name, value in wanted.items() if _is_known_option(name, value)}
    return jax.jit(function, compiler_options=known or None, **options)


@functools.cache
def _is_known_option(name: str, value: int | bool | str) -> bool:
    """Whether the compiler takes an option, found once by compiling a program without operations (15 ms)."""
    try:
        probe = jax.jit(lambda x: x, compiler_options={name: value})
        probe.lower(jax.ShapeDtypeStruct((), jnp.float32)).compile()
    except jax.errors.JaxRuntimeError as error:
        warnings.warn(
            f"jax {jax.__version__} does not take the compiler option {name}={value}: {error}. Runs are as right without "
            "it, but may be slower.",
            stacklevel=2,
        )
        return False
    return True
