"""Registration of classes as nodes of JAX pytrees, without importing JAX.

A *pytree* is a tree of objects that JAX can *flatten*, i.e. split into its *leaves*, the numbers that JAX traces,
batches and differentiates, and its constant *structure*. An object of a registered class is a *node* of such a tree;
its *children* are nodes or leaves. A class must be registered before JAX flattens an object of this class, but
importing zwidth must not import JAX, which takes 0.4 s. `register` therefore registers a class at once if JAX is
loaded, otherwise as soon as the program imports JAX.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, Protocol

_nodes: set[type] = set()  # registered classes
_waiting: list[type[Node]] = []  # registered classes that are not yet passed to JAX


class Node(Protocol):
    """A class whose objects JAX can flatten into children and a constant structure."""

    def _flatten(self) -> tuple[tuple[tuple[str, Any], ...], Any]:
        """Return the children of the object with their names, and its constant, hashable structure."""
        ...

    @classmethod
    def _unflatten(cls, structure: Any, children: Any) -> Any:
        """Return an object from its structure and its children, without checks, because JAX may pass tracers."""
        ...


class HiddenText(tuple[Any, ...]):
    """Texts in the structure of a JAX pytree; they always compare equal, so that JAX compiles once for all texts."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HiddenText)

    def __ne__(self, other: object) -> bool:
        return not isinstance(other, HiddenText)

    def __hash__(self) -> int:
        return 0


def register(kind: type[Node]) -> None:
    """Register a class as a node of JAX pytrees: at once if JAX is loaded, otherwise when JAX is imported."""
    _nodes.add(kind)
    _waiting.append(kind)
    register_waiting()


def is_node(value: object) -> bool:
    """Return whether the class of an object is registered as a node of JAX pytrees."""
    return type(value) in _nodes


def list_leaves(tree: Any) -> list[Any]:
    """Return the leaves (numbers) of a registered object, or of a tuple of such objects, in the order of JAX."""
    if not (is_node(tree) or isinstance(tree, tuple)):
        return [tree]
    children = tree if isinstance(tree, tuple) else [child for _, child in tree._flatten()[0]]
    return [leaf for child in children for leaf in list_leaves(child)]


def replace_leaves(tree: Any, leaves: Iterator[Any]) -> Any:
    """Return a copy of a JAX pytree in which the leaves are replaced by the given ones, without checks."""
    if isinstance(tree, tuple):
        return tuple([replace_leaves(each, leaves) for each in tree])
    if not is_node(tree):
        return next(leaves)
    children, structure = tree._flatten()
    return type(tree)._unflatten(structure, [replace_leaves(child, leaves) for _, child in children])


def register_waiting() -> None:
    """Pass all waiting classes to JAX if JAX is loaded."""
    # Use ``vars``, because ``getattr`` would load JAX if its module is lazy (importlib.util.LazyLoader).
    if not _waiting or "tree_util" not in vars(sys.modules.get("jax", sys)):
        return
    from jax.tree_util import GetAttrKey, register_pytree_with_keys

    while _waiting:
        kind = _waiting.pop()

        def flatten_with_keys(node: Node) -> tuple[list[tuple[Any, Any]], Any]:
            children, structure = node._flatten()
            return [(GetAttrKey(name), child) for name, child in children], structure

        def flatten(node: Node) -> tuple[tuple[Any, ...], Any]:
            children, structure = node._flatten()
            return tuple([child for _, child in children]), structure

        register_pytree_with_keys(kind, flatten_with_keys, kind._unflatten, flatten)


class _Watcher:
    """An import finder (`sys.meta_path`) that passes the waiting classes to JAX as soon as JAX is imported."""

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the import specification of `jax`, obtained from the other finders; None for other modules."""
        if name != "jax":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        specs = (finder.find_spec(name, path, target) for finder in others)
        spec = next((spec for spec in specs if spec is not None), None)
        loader = None if spec is None else spec.loader
        if loader is None:
            return spec
        execute = loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            register_waiting()

        loader.exec_module = execute_and_register
        return spec


if "jax" not in sys.modules:
    sys.meta_path.insert(0, _Watcher())
