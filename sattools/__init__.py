"""Satellite images with RPC cameras to surface models and reflectance maps by differentiable rendering.

    import sattools

    scene = sattools.prepare(["a.tif", "b.tif", "c.tif"])
    scene = sattools.export(sattools.fit(scene))
    print(scene.dsm())

See `sattools.api` for the functions; nothing heavy is imported before it is used.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.3.0"

if TYPE_CHECKING:
    from inspect import Signature

    from sattools.api import match, normalise, prepare
    from sattools.camera.rpc import RPC
    from sattools.scene import Grid, Scene

_API = "sattools.api"
_HOMES = {
    "Scene": "sattools.scene", "Grid": "sattools.scene", "RPC": "sattools.camera.rpc", "prepare": _API,
    "normalise": _API, "match": _API,
}  # fmt: skip
# packages that are functions as well
_STAGES = ("fit", "export", "align", "compare", "change", "simulate")


class _Stage(ModuleType):
    """A package that stands for the function of `sattools.api` of its name, too."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Call ``sattools.api.NAME``; see its documentation."""
        return self._function()(*arguments, **options)

    def _function(self) -> Callable[..., Any]:
        function: Callable[..., Any] = getattr(importlib.import_module(_API), self.__name__.rpartition(".")[2])
        return function

    @property
    def __signature__(self) -> Signature:
        """Of the function, for `inspect` and notebooks."""
        from inspect import signature

        return signature(self._function())

    @property
    def __doc__(self) -> str:  # type: ignore[override]
        """What the package is, and what the function takes, for `help`."""
        from inspect import getdoc

        name = self.__name__
        called = f"Called, it is `{_API}.{name.rpartition('.')[2]}`:\n\n    {name}{self.__signature__}\n"
        return f"{self.__dict__['__doc__']}\n\n{called}\n{getdoc(self._function())}"

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        """By its name, as a function is: pools of processes hand it on."""
        return importlib.import_module, (self.__name__,)


class _Suite(ModuleType):
    """This package, which lets the packages of its stages be called, of which none has to know that.

    Python makes a submodule an attribute of its package as soon as anything imports it, so a function of the same name
    would come and go. A package that can be called is the same thing at all times.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        """Python calls it when it has imported a package, before anybody else gets that."""
        if name in _STAGES and isinstance(value, ModuleType):
            value.__class__ = _Stage
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Suite


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    if name in _STAGES:
        return importlib.import_module(f"sattools.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, *_STAGES})


__all__ = [
    "RPC", "Grid", "Scene", "__version__", "align", "change", "compare", "export", "fit", "match", "normalise",
    "prepare", "simulate",
]  # fmt: skip
