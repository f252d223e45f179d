"""hyrfpack: posed photos -> a hybrid radiance field -> a small `.hyrf` file -> pictures from anywhere.

    import hyrfpack

    scene = hyrfpack.load_scene("data/bonsai")
    result = hyrfpack.train(scene, "runs/bonsai", hyrfpack.TrainConfig(steps=3000))
    hyrfpack.compress("runs/bonsai/model.hyrf", "bonsai.hyrf")
    model = hyrfpack.load("bonsai.hyrf")
    print(hyrfpack.evaluate(model, scene.test).psnr)
    picture = hyrfpack.render(model, scene.test[0].camera).rgb

Importing hyrfpack loads nothing else; each name below brings what it needs at its first use.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

__version__ = "0.1.0"

# Public name -> the module that defines it.
_PUBLIC = {
    "Camera": "hyrfpack.scene",
    "Picture": "hyrfpack.scene",
    "Scene": "hyrfpack.scene",
    "View": "hyrfpack.scene",
    "HyrfDataError": "hyrfpack.errors",
    "HyrfError": "hyrfpack.errors",
    "HyrfFormatError": "hyrfpack.errors",
    "HyrfTrainingError": "hyrfpack.errors",
    "load_scene": "hyrfpack.data",
    "HybridModel": "hyrfpack.model",
    "ModelConfig": "hyrfpack.model",
    "BenchReport": "hyrfpack.bench",
    "RenderSettings": "hyrfpack.render",
    "Rendering": "hyrfpack.render",
    "TrainConfig": "hyrfpack.train",
    "TrainResult": "hyrfpack.train",
    "Evaluation": "hyrfpack.evaluate",
    "DistillConfig": "hyrfpack.distill",
    "DistillReport": "hyrfpack.distill",
    "ExportReport": "hyrfpack.export",
    "CompressionReport": "hyrfpack.format",
    "describe": "hyrfpack.format",
    "load": "hyrfpack.format",
    "save": "hyrfpack.format",
}
# Sub-packages that are also the one function they are about: `hyrfpack.render(...)` calls `hyrfpack.render.render`.
_CALLABLE = ("bench", "compress", "distill", "evaluate", "export", "render", "train")

__all__ = ["__version__", *_CALLABLE, *_PUBLIC]


class _CallablePackage(ModuleType):
    """A sub-package that can be called as the function of its own name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **kwargs)


class _Package(ModuleType):
    """This package: gives the callable sub-packages their class when the import system binds them here."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _CALLABLE and isinstance(value, ModuleType):
            value.__class__ = _CallablePackage
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name in _CALLABLE:
        return import_module(f"{__name__}.{name}")
    if name in _PUBLIC:
        value = getattr(import_module(_PUBLIC[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
