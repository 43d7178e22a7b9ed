"""`pdoc physjax` documents every public name, also those that `import physjax` does not load."""

import inspect
import warnings
from types import ModuleType

import pdoc.doc
import pdoc.extract
import pytest

import physjax

NAMESPACES = [thing for name in physjax.__all__ if isinstance(thing := getattr(physjax, name), ModuleType)]


@pytest.fixture(scope="module")
def pages():
    """The modules that pdoc writes a page for; a name or a type that does not resolve is a warning, and an error here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        modules = [pdoc.doc.Module.from_name(name) for name in pdoc.extract.walk_specs(["physjax"])]
        assert all(module.docstring and module.members is not None for module in modules)
        assert sum(len(resolve_types(module)) for module in modules) > 1000
    return modules


def resolve_types(part):
    """The types of all parameters and fields of a module or a class, which pdoc resolves when it is asked for them."""
    if part.kind == "function":
        return [parameter.annotation for parameter in part.signature.parameters.values()]
    if part.kind == "variable":
        return [part.annotation]
    return [found for member in part.members.values() if member.kind != "module" for found in resolve_types(member)]


def find_page(module, pages):
    """The page of a module; one that has moved has it under its old, shorter name."""
    faces = [page for page in pages if page.fullname == module.__name__]
    return (faces or [page for page in pages if getattr(page.obj, "__all__", None) == module.__all__])[0]


@pytest.mark.parametrize("namespace", [physjax, *NAMESPACES], ids=lambda namespace: namespace.__name__)
def test_every_public_name_is_documented_on_a_page(namespace, pages):
    members = find_page(namespace, pages).members
    for name in getattr(namespace, "__all__", ()):
        thing = getattr(namespace, name)
        if inspect.ismodule(thing):
            assert find_page(thing, pages).docstring, name
        elif getattr(thing, "__name__", None) == name:
            assert members[name].docstring, name
        else:  # a constant or an old name: shown with what it is, and documented where that is defined
            assert name in members, name
