"""What a run keeps, held against the memory there is before anything is computed."""

import functools
import os

import jax

from physjax.text import format_bytes


@functools.cache
def read_memory_limit() -> int | None:
    """The memory of the default device [bytes]: a GPU's as JAX may use it, else the machine's; None if unknown."""
    known = jax.local_devices()[0].memory_stats()  # those of other processes cannot be asked
    if known and "bytes_limit" in known:
        return known["bytes_limit"]
    names = getattr(os, "sysconf_names", {})
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if "SC_PHYS_PAGES" in names else None


def demand_memory_for_frames(state: object, steps: int, save_every: int) -> None:
    """Raise a MemoryError, before anything is compiled, where the frames of a run cannot fit.

    They are counted twice: once as they come, and once with the start in front.
    """
    limit = read_memory_limit()
    frame = 2 * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    frames = steps // save_every + 1
    if limit is None or frames * frame <= limit:
        return
    fitting = limit // frame - 1
    fewer = f"save_every={-(-steps // fitting)} or more, " if fitting >= 1 else ""
    raise MemoryError(
        f"simulate: got {frames:,} frames of {format_bytes(frame // 2)}, which take {format_bytes(frames * frame)} while they "
        f"are put together; expected at most {format_bytes(limit)}, which is what the device has. Keep less: {fewer}"
        "record= for what you need of a frame, or fewer lanes."
    )
