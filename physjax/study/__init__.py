"""What you ask of a scene: accuracy, stability, energy, ablation, sweeps and inverse problems, each with its charts."""

from physjax.lazy import serve_submodules

__all__, __getattr__, __dir__ = serve_submodules(__name__, __path__)
