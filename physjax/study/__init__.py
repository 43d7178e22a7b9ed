"""What you ask of a scene: accuracy, stability, energy, ablation, sweeps and inverse problems, each with its charts.

# Known limitations

- `accuracy.recommend` searches for fifteen processor seconds by default and names what it did not reach. Timed impacts take so
  long to compile that few methods are tried there; where contacts are resolved at the end of a step, no reference is known well
  enough to promise small errors. The run times that `accuracy.ablate` compares are only as good as the machine is quiet.
- A sweep's folder is locked by `flock`, so `out=` needs Linux or macOS. A function behind `jax.pure_callback` is identified by
  its code, constants, closures and globals; one that cannot be identified completely (methods of objects, files, random
  generators, `io_callback`, `jax.ffi`) is refused with `out=`.
- `aim_at` through bounces tries 256 directions in the plane and 768 in space, and may miss a hit that is narrower than their
  spacing; its first run takes five seconds, its gradient several times as long. For a target out of reach the derivatives
  are zero.
- `solve`, `minimise` and `fit` search with optimistix: on two threads one lane in 150 000 ended with a different last digit or
  number of steps.
- `energy.ledger` does not follow the births and deaths of an emitter.
"""

from physjax.lazy import serve_submodules

__all__, __getattr__, __dir__ = serve_submodules(__name__, __path__)
