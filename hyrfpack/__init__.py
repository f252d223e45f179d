"""hyrfpack: photos or a video -> poses -> a hybrid radiance field -> a small `.hyrf` file -> pictures from anywhere.

    import hyrfpack

    scene = hyrfpack.load_scene("data/bonsai")
    result = hyrfpack.train(scene, "runs/bonsai", hyrfpack.TrainConfig(steps=3000))
    hyrfpack.compress("runs/bonsai", "bonsai.hyrf")
    model = hyrfpack.load("bonsai.hyrf")
    print(hyrfpack.evaluate(model, scene.test).psnr)
    picture = hyrfpack.render(model, scene.test[0].camera).rgb

Importing hyrfpack loads nothing else; each name below brings what it needs at its first use.
"""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from hyrfpack.version import __version__

_TOO_LATE = sys.platform == "linux" and "pycolmap" in sys.modules and "zlib" not in sys.modules
# Before pycolmap, wherever that is loaded: its wheel for Linux exports a zlib of its own, and the system's, when it is
# loaded second, calls into that one. Memory is corrupted then, and the process aborts at the next PNG or .spz file.
import zlib  # noqa: E402, F401

if _TOO_LATE:
    warnings.warn(
        "pycolmap was imported before zlib, so that compressing anything may abort this process: "
        "import hyrfpack (or zlib) first",
        RuntimeWarning,
        stacklevel=2,
    )

if TYPE_CHECKING:
    from hyrfpack.bench import BenchReport as BenchReport
    from hyrfpack.bench import bench as bench
    from hyrfpack.compare import ComparisonReport as ComparisonReport
    from hyrfpack.compare import compare as compare
    from hyrfpack.compress import compress as compress
    from hyrfpack.data import load_scene as load_scene
    from hyrfpack.distill import DistillConfig as DistillConfig
    from hyrfpack.distill import DistillReport as DistillReport
    from hyrfpack.distill import distill as distill
    from hyrfpack.errors import HyrfDataError as HyrfDataError
    from hyrfpack.errors import HyrfError as HyrfError
    from hyrfpack.errors import HyrfFormatError as HyrfFormatError
    from hyrfpack.errors import HyrfNoPosesError as HyrfNoPosesError
    from hyrfpack.errors import HyrfTrainingError as HyrfTrainingError
    from hyrfpack.evaluate import Evaluation as Evaluation
    from hyrfpack.evaluate import evaluate as evaluate
    from hyrfpack.export import ConversionReport as ConversionReport
    from hyrfpack.export import ExportReport as ExportReport
    from hyrfpack.export import convert as convert
    from hyrfpack.export import export as export
    from hyrfpack.format import describe as describe
    from hyrfpack.format.codec import CompressionReport as CompressionReport
    from hyrfpack.format.codec import load as load
    from hyrfpack.format.codec import save as save
    from hyrfpack.make import MakeResult as MakeResult
    from hyrfpack.make import PhotoSurvey as PhotoSurvey
    from hyrfpack.make import describe_photos as describe_photos
    from hyrfpack.make import make as make
    from hyrfpack.model import HybridModel as HybridModel
    from hyrfpack.model import ModelConfig as ModelConfig
    from hyrfpack.poses import PosesReport as PosesReport
    from hyrfpack.poses import estimate_poses as estimate_poses
    from hyrfpack.render import Rendering as Rendering
    from hyrfpack.render import RenderSettings as RenderSettings
    from hyrfpack.render import render as render
    from hyrfpack.scene import Camera as Camera
    from hyrfpack.scene import Picture as Picture
    from hyrfpack.scene import Scene as Scene
    from hyrfpack.scene import View as View
    from hyrfpack.train import TrainConfig as TrainConfig
    from hyrfpack.train import TrainResult as TrainResult
    from hyrfpack.train import train as train

# Public name -> the module that has it.
_PUBLIC = {
    "Camera": "hyrfpack.scene",
    "Picture": "hyrfpack.scene",
    "Scene": "hyrfpack.scene",
    "View": "hyrfpack.scene",
    "HyrfDataError": "hyrfpack.errors",
    "HyrfError": "hyrfpack.errors",
    "HyrfFormatError": "hyrfpack.errors",
    "HyrfNoPosesError": "hyrfpack.errors",
    "HyrfTrainingError": "hyrfpack.errors",
    "load_scene": "hyrfpack.data",
    "PosesReport": "hyrfpack.poses",
    "estimate_poses": "hyrfpack.poses",
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
    "ComparisonReport": "hyrfpack.compare",
    "ConversionReport": "hyrfpack.export",
    "ExportReport": "hyrfpack.export",
    "convert": "hyrfpack.export",
    "MakeResult": "hyrfpack.make",
    "PhotoSurvey": "hyrfpack.make",
    "describe_photos": "hyrfpack.make",
    "CompressionReport": "hyrfpack.format",
    "describe": "hyrfpack.format",
    "load": "hyrfpack.format",
    "save": "hyrfpack.format",
}
# Functions that a sub-package has the name of: `hyrfpack.render` is `hyrfpack.render.render`.
_NAMESAKES = ("bench", "compare", "compress", "distill", "evaluate", "export", "make", "render", "train")

__all__ = ["__version__", *_NAMESAKES, *_PUBLIC]


class _Package(ModuleType):
    """This package: the function takes the place of its namesake when the import system binds that here."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _NAMESAKES and isinstance(value, ModuleType):
            package, value = value, getattr(value, name)
            # What belongs to the sub-package can be reached through the function, too: `hyrfpack.train.Trainer`.
            vars(package).update(vars(value))
            value.__dict__ = vars(package)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


if not TYPE_CHECKING:  # checkers know all there is, and shall tell of what is not

    def __getattr__(name: str) -> Any:
        if name in _NAMESAKES:
            import_module(f"{__name__}.{name}")
            return globals()[name]
        if name in _PUBLIC:
            value = getattr(import_module(_PUBLIC[name]), name)
            globals()[name] = value
            return value
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
