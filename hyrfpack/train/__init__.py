"""Train a HybridModel on posed photos, and write it into a run folder."""

from hyrfpack.train.config import PRESETS, DensityConfig, LearningRates, TrainConfig
from hyrfpack.train.density import DensityControl
from hyrfpack.train.photos import load_training_scene
from hyrfpack.train.run import TrainResult, train_model
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
