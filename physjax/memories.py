"""The parts of a scene that remember something: which they are, and how their memories are replaced."""

from jaxtyping import PyTree

from physjax.memory_masks import has_memory
from physjax.scene import Scene


def select_stateful_parts(scene: Scene) -> tuple:
    """The parts of the scene with memory: forces that advance, contacts that remember since when lanes touch them, an emitter."""
    return tuple(part for part in (*scene.forces, *scene.contacts, scene.emitter) if has_memory(part))


def replace_memories(scene: Scene, state: PyTree, parts: tuple) -> Scene:
    """The scene with another state, and with other memories in those of its parts that have some."""
    remaining = iter(parts)
    renewed = lambda old: tuple(next(remaining) if has_memory(part) else part for part in old)  # noqa: E731
    forces, contacts, (emitter,) = renewed(scene.forces), renewed(scene.contacts), renewed((scene.emitter,))
    return scene.replace(state=state, forces=forces, contacts=contacts, emitter=emitter)
