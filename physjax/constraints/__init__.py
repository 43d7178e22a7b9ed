"""What is held exactly: joints whose ends stay together under every method, at any mass ratio, without stiffness.

A `Constraint` is a part of a scene, among its forces, that says by how much its joints are off. `rattle` keeps a step on
them, `impulses` finds what that takes, `mechanism` joins all parts to one system, which `block_solve` solves directly in the
order of `elimination`. `reactions` are the forces of joints, and the speeds that they allow.
"""

from physjax.constraints.constraint import Constraint
from physjax.constraints.reactions import constraint_forces, project_joints

__all__ = ["Constraint", "constraint_forces", "project_joints"]


def __dir__() -> list[str]:
    return __all__
