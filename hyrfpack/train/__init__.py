"""Train a HybridModel on posed photos, and write it into a run folder."""

from hyrfpack.choices import PRESETS
from hyrfpack.config.train import DensityConfig, LearningRates, TrainConfig
from hyrfpack.train.density import DensityControl
from hyrfpack.train.finish import TrainResult
from hyrfpack.train.photos import load_training_scene
from hyrfpack.train.run import train_model
from hyrfpack.train.strategy import Strategy
from hyrfpack.train.trainer import Trainer

__all__ = [
    "PRESETS",
    "DensityConfig",
    "DensityControl",
    "LearningRates",
    "Strategy",
    "TrainConfig",
    "TrainResult",
    "Trainer",
    "load_training_scene",
    "train_model",
]
