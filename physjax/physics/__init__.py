"""What acts on a scene: forces, springs, contacts, rigid bodies and emitters, each usable under every method."""

from physjax.lazy import serve_submodules

__all__, __getattr__, __dir__ = serve_submodules(__name__, __path__)
