"""hyrfpack: photos or a video -> poses -> a hybrid radiance field -> a small `.hyrf` file -> pictures from anywhere.

    import hyrfpack

    scene = hyrfpack.load_scene("data/bonsai")
    result = hyrfpack.train_model(scene, "runs/bonsai", hyrfpack.TrainConfig(steps=3000))
    hyrfpack.compress_model("runs/bonsai", "bonsai.hyrf")
    model = hyrfpack.load_model("bonsai.hyrf")
    print(hyrfpack.evaluate_model(model, scene.test).psnr)
    picture = hyrfpack.render_view(model, scene.test[0].camera).rgb

Importing hyrfpack loads none of its packages. Each name below loads what it needs when it is first used.
"""

from __future__ import annotations

import logging
import sys
import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

from hyrfpack.version import __version__

# Programs that use the library see its messages only if they configure logging.
logging.getLogger(__name__).addHandler(logging.NullHandler())

_TOO_LATE = sys.platform == "linux" and "pycolmap" in sys.modules and "zlib" not in sys.modules
# zlib must be loaded before pycolmap, whose wheel for Linux exports a zlib of its own. If the system's zlib is loaded
# second, it calls into that one and corrupts memory, and the process aborts at the next PNG or .spz file.
import zlib  # noqa: E402, F401

if _TOO_LATE:
    warnings.warn(
        "pycolmap was imported before zlib, so that compressing anything may abort this process: "
        "import hyrfpack (or zlib) first",
        RuntimeWarning,
        stacklevel=2,
    )

if TYPE_CHECKING:
    from hyrfpack.bench.suite import BenchReport as BenchReport
    from hyrfpack.bench.suite import benchmark_model as benchmark_model
    from hyrfpack.blocks import train_blocks as train_blocks
    from hyrfpack.cameras.capture import place_photos as place_photos
    from hyrfpack.compress import CompressionReport as CompressionReport
    from hyrfpack.compress import compress_model as compress_model
    from hyrfpack.config.compress import CompressConfig as CompressConfig
    from hyrfpack.config.compress import PaperSettings as PaperSettings
    from hyrfpack.config.export import ConvertConfig as ConvertConfig
    from hyrfpack.config.export import ExportConfig as ExportConfig
    from hyrfpack.config.make import MakeConfig as MakeConfig
    from hyrfpack.config.poses import PosesConfig as PosesConfig
    from hyrfpack.config.split import SplitConfig as SplitConfig
    from hyrfpack.context import RunContext as RunContext
    from hyrfpack.data import load_scene as load_scene
    from hyrfpack.doctor import MachineReport as MachineReport
    from hyrfpack.doctor import diagnose_machine as diagnose_machine
    from hyrfpack.edit import EditReport as EditReport
    from hyrfpack.edit import MergeReport as MergeReport
    from hyrfpack.edit import edit_model as edit_model
    from hyrfpack.edit import merge_models as merge_models
    from hyrfpack.edit import plan_edit as plan_edit
    from hyrfpack.errors import HyrfDataError as HyrfDataError
    from hyrfpack.errors import HyrfError as HyrfError
    from hyrfpack.errors import HyrfFormatError as HyrfFormatError
    from hyrfpack.errors import HyrfNoPosesError as HyrfNoPosesError
    from hyrfpack.errors import HyrfSizeError as HyrfSizeError
    from hyrfpack.errors import HyrfTrainingError as HyrfTrainingError
    from hyrfpack.evaluate import Evaluation as Evaluation
    from hyrfpack.evaluate import evaluate_model as evaluate_model
    from hyrfpack.export import ConversionReport as ConversionReport
    from hyrfpack.export import ExportReport as ExportReport
    from hyrfpack.export import convert_splats as convert_splats
    from hyrfpack.export import export_gallery as export_gallery
    from hyrfpack.export import export_model as export_model
    from hyrfpack.export import export_player as export_player
    from hyrfpack.format import FileReport as FileReport
    from hyrfpack.format import describe_file as describe_file
    from hyrfpack.format.codec import load_model as load_model
    from hyrfpack.format.codec import save_model as save_model
    from hyrfpack.format.parts import load_merged_model as load_merged_model
    from hyrfpack.format.scene_folder import SceneFolder as SceneFolder
    from hyrfpack.imports import ImportConfig as ImportConfig
    from hyrfpack.imports import ImportReport as ImportReport
    from hyrfpack.imports import import_splats as import_splats
    from hyrfpack.lod import LevelSelection as LevelSelection
    from hyrfpack.lod import SplitReport as SplitReport
    from hyrfpack.lod import select_levels as select_levels
    from hyrfpack.lod import split_model as split_model
    from hyrfpack.make import MakeResult as MakeResult
    from hyrfpack.make import make_scene as make_scene
    from hyrfpack.model import HybridModel as HybridModel
    from hyrfpack.model import ModelConfig as ModelConfig
    from hyrfpack.model.merged import MergedModel as MergedModel
    from hyrfpack.poses import PosesReport as PosesReport
    from hyrfpack.poses import estimate_poses as estimate_poses
    from hyrfpack.render import Rendering as Rendering
    from hyrfpack.render import RenderSettings as RenderSettings
    from hyrfpack.render import render_view as render_view
    from hyrfpack.report import ComparisonReport as ComparisonReport
    from hyrfpack.report import compare_runs as compare_runs
    from hyrfpack.scene import Camera as Camera
    from hyrfpack.scene import Picture as Picture
    from hyrfpack.scene import Scene as Scene
    from hyrfpack.scene import View as View
    from hyrfpack.survey import PhotoSurvey as PhotoSurvey
    from hyrfpack.survey import describe_photos as describe_photos
    from hyrfpack.train import TrainConfig as TrainConfig
    from hyrfpack.train import TrainResult as TrainResult
    from hyrfpack.train import train_model as train_model

# The module that defines or re-exports each public name.
_MODULES_BY_PUBLIC_NAME = {
    "BenchReport": "hyrfpack.bench.suite",
    "benchmark_model": "hyrfpack.bench.suite",
    "train_blocks": "hyrfpack.blocks",
    "place_photos": "hyrfpack.cameras.capture",
    "ComparisonReport": "hyrfpack.report",
    "compare_runs": "hyrfpack.report",
    "CompressionReport": "hyrfpack.compress",
    "compress_model": "hyrfpack.compress",
    "CompressConfig": "hyrfpack.config.compress",
    "PaperSettings": "hyrfpack.config.compress",
    "SceneFolder": "hyrfpack.format.scene_folder",
    "SplitConfig": "hyrfpack.config.split",
    "LevelSelection": "hyrfpack.lod",
    "SplitReport": "hyrfpack.lod",
    "select_levels": "hyrfpack.lod",
    "split_model": "hyrfpack.lod",
    "RunContext": "hyrfpack.context",
    "load_scene": "hyrfpack.data",
    "ImportConfig": "hyrfpack.imports",
    "ImportReport": "hyrfpack.imports",
    "import_splats": "hyrfpack.imports",
    "MachineReport": "hyrfpack.doctor",
    "diagnose_machine": "hyrfpack.doctor",
    "EditReport": "hyrfpack.edit",
    "MergeReport": "hyrfpack.edit",
    "edit_model": "hyrfpack.edit",
    "merge_models": "hyrfpack.edit",
    "plan_edit": "hyrfpack.edit",
    "HyrfDataError": "hyrfpack.errors",
    "HyrfError": "hyrfpack.errors",
    "HyrfFormatError": "hyrfpack.errors",
    "HyrfNoPosesError": "hyrfpack.errors",
    "HyrfSizeError": "hyrfpack.errors",
    "HyrfTrainingError": "hyrfpack.errors",
    "Evaluation": "hyrfpack.evaluate",
    "evaluate_model": "hyrfpack.evaluate",
    "ConvertConfig": "hyrfpack.config.export",
    "ExportConfig": "hyrfpack.config.export",
    "ConversionReport": "hyrfpack.export",
    "ExportReport": "hyrfpack.export",
    "convert_splats": "hyrfpack.export",
    "export_gallery": "hyrfpack.export",
    "export_model": "hyrfpack.export",
    "export_player": "hyrfpack.export",
    "describe_file": "hyrfpack.format",
    "FileReport": "hyrfpack.format",
    "load_merged_model": "hyrfpack.format",
    "load_model": "hyrfpack.format",
    "save_model": "hyrfpack.format",
    "MakeConfig": "hyrfpack.config.make",
    "MakeResult": "hyrfpack.make",
    "make_scene": "hyrfpack.make",
    "HybridModel": "hyrfpack.model",
    "MergedModel": "hyrfpack.model.merged",
    "ModelConfig": "hyrfpack.model",
    "PosesConfig": "hyrfpack.config.poses",
    "PosesReport": "hyrfpack.poses",
    "estimate_poses": "hyrfpack.poses",
    "Rendering": "hyrfpack.render",
    "RenderSettings": "hyrfpack.render",
    "render_view": "hyrfpack.render",
    "Camera": "hyrfpack.scene",
    "Picture": "hyrfpack.scene",
    "Scene": "hyrfpack.scene",
    "View": "hyrfpack.scene",
    "PhotoSurvey": "hyrfpack.survey",
    "describe_photos": "hyrfpack.survey",
    "TrainConfig": "hyrfpack.train",
    "TrainResult": "hyrfpack.train",
    "train_model": "hyrfpack.train",
}
# The new name of each renamed public function, for the error message.
_NEW_NAMES_BY_OLD_NAME = {
    "bench": "benchmark_model",
    "compare": "compare_runs",
    "compress": "compress_model",
    "convert": "convert_splats",
    "describe": "describe_file",
    "distill": "import_splats",
    "DistillConfig": "ImportConfig",
    "DistillReport": "ImportReport",
    "evaluate": "evaluate_model",
    "export": "export_model",
    "load": "load_model",
    "save": "save_model",
    "make": "make_scene",
    "render": "render_view",
    "train": "train_model",
}

__all__ = ["__version__", *_MODULES_BY_PUBLIC_NAME]


if not TYPE_CHECKING:  # Type checkers read the imports above, so that they report unknown names.

    def __getattr__(name: str) -> Any:
        if name in _MODULES_BY_PUBLIC_NAME:
            from hyrfpack.errors import needs_package

            with needs_package(f"hyrfpack.{name}"):
                value = getattr(import_module(_MODULES_BY_PUBLIC_NAME[name]), name)
            globals()[name] = value
            return value
        hint = f"; the name is now hyrfpack.{_NEW_NAMES_BY_OLD_NAME[name]}" if name in _NEW_NAMES_BY_OLD_NAME else ""
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'{hint}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
