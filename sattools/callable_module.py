"""`sattools.fit` is a package and, as everybody expects, a function: the packages of stages can be called.

Python makes a submodule an attribute of its package as soon as anything imports it, so a function of the same name
would come and go. A package whose module can be called is the same thing at all times.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any


class CallableModule(ModuleType):
    """A module that stands for the function of `sattools.api` of the same name."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Call ``sattools.api.NAME``; see its documentation."""
        api = importlib.import_module("sattools.api")
        return getattr(api, self.__name__.rpartition(".")[2])(*arguments, **options)

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        """By its name, as a function is: pools of processes hand it on."""
        return importlib.import_module, (self.__name__,)


def make_callable(name: str) -> None:
    """Let the package ``name`` (its ``__name__``) be called."""
    sys.modules[name].__class__ = CallableModule


__all__ = ["make_callable"]
