"""How a scene moves: the methods, the loop that repeats their steps, and the bridge to diffrax."""

from physjax.lazy import serve_submodules

__all__, __getattr__, __dir__ = serve_submodules(__name__, __path__)
