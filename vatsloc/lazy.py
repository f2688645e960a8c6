"""Front doors that cost nothing until they are used: a package names what it offers and imports it on first use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def on_first_use(homes: Mapping[str, tuple[str, ...]]) -> Callable[[str], Any]:
    """The `__getattr__` of a package (PEP 562). homes: module -> names that the package hands on from it."""
    home = {name: module for module, names in homes.items() for name in names}

    def getattr_of_package(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"no name {name!r} in this package; it hands on {', '.join(sorted(home))}")
        return getattr(import_module(home[name]), name)

    return getattr_of_package
