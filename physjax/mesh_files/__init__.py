"""Readers of mesh files that need no other package: OBJ and PLY."""

from physjax.mesh_files.common import Polygons
from physjax.mesh_files.obj import read_obj
from physjax.mesh_files.ply import read_ply

__all__ = ["Polygons", "read_obj", "read_ply"]


def __dir__() -> list[str]:
    return __all__
