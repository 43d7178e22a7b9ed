"""What you look at: plots, films, pages to turn in 3-D, and exports of a run."""

from physjax.lazy import serve_submodules

__all__, __getattr__, __dir__ = serve_submodules(__name__, __path__)
