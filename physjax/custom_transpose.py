"""Linear maps with a transpose of their own, so that reverse mode costs no more than the map.

JAX transposes a slice into a padded array and a gather into a scatter, and adds these up. A map between nodes and springs
has a transpose made of slices and gathers as well, which is stated here. Works under jit, vmap and derivatives of any
order in both modes, of which a `jax.custom_vjp` has the reverse one only.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

_linear_primitive = Primitive("linear_with_transpose")
_linear_primitive.multiple_results = True

LinearMap = Callable[..., list[Array]]
"""A linear function of arrays that gives a list of arrays."""


def apply_linear(forward: LinearMap, backward: LinearMap, arrays: Sequence[Array]) -> list[Array]:
    """`forward(*arrays)`, a list of arrays that depends linearly on them, with `backward` as its transpose.

    Both must accept any leading axes as batch axes, and must not close over traced arrays: they are parameters of the
    primitive.
    """
    return _linear_primitive.bind(*arrays, forward=forward, backward=backward)


@_linear_primitive.def_impl
def _apply_forward(*arrays: Array, forward: LinearMap, backward: LinearMap) -> list[Array]:
    return forward(*arrays)


@_linear_primitive.def_abstract_eval
def _infer_shapes(*arrays: ShapedArray, forward: LinearMap, backward: LinearMap) -> list[ShapedArray]:
    shapes = jax.eval_shape(forward, *(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in arrays))
    return [ShapedArray(s.shape, s.dtype) for s in shapes]


def _differentiate(
    primals: Sequence[Array], tangents: Sequence[Array | ad.Zero], **maps: LinearMap
) -> tuple[list[Array], list[Array]]:
    tangents = [ad.instantiate_zeros(t) for t in tangents]
    return _linear_primitive.bind(*primals, **maps), _linear_primitive.bind(*tangents, **maps)


def _transpose(
    cotangents: Sequence[Array | ad.Zero], *arrays: object, forward: LinearMap, backward: LinearMap
) -> list[Array]:
    return _linear_primitive.bind(*(ad.instantiate_zeros(c) for c in cotangents), forward=backward, backward=forward)


def _batch(arrays: Sequence[Array], axes: Sequence[int | None], **maps: LinearMap) -> tuple[list[Array], list[int]]:
    size = next(a.shape[i] for a, i in zip(arrays, axes, strict=True) if i is not None)
    front = [
        jnp.broadcast_to(a, (size, *a.shape)) if i is None else jnp.moveaxis(a, i, 0)
        for a, i in zip(arrays, axes, strict=True)
    ]
    found = _linear_primitive.bind(*front, **maps)
    return found, [0] * len(found)


mlir.register_lowering(_linear_primitive, mlir.lower_fun(_apply_forward, multiple_results=True))
ad.primitive_jvps[_linear_primitive] = _differentiate
ad.primitive_transposes[_linear_primitive] = _transpose
batching.primitive_batchers[_linear_primitive] = _batch
