"""Settings of a compression are checked when they are made."""

from __future__ import annotations

import pytest

from hyrfpack.config.compress import CompressConfig, PaperSettings
from hyrfpack.errors import HyrfError


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"profile": "zip"}, "profile is 'zip'; it must be one of raw, paper, compact"),
        ({"distortion": 0.0}, "distortion is 0.0"),
        ({"distortion": float("nan")}, "distortion is nan"),
        ({"target_bytes": 0}, "target_bytes is 0"),
        ({"target_bytes": "2MB"}, "target_bytes is '2MB'"),
        ({"max_psnr_drop": -0.1}, "max_psnr_drop is -0.1"),
        ({"finetune_steps": 0}, "finetune_steps is 0"),
        ({"prune": 1}, "prune is 1"),
    ],
)
def test_a_value_out_of_range_is_an_error_that_names_the_setting(settings, words):
    with pytest.raises(ValueError, match=words):
        CompressConfig(**settings)


@pytest.mark.parametrize("color", [(0, 64), (17, 64), (2, 0), (2, 257), (2.5, 64), ("2", 64)])
def test_stages_and_codewords_of_paper_are_limited(color):
    with pytest.raises(HyrfError, match="use 1 to 16 stages of 1 to 256"):
        PaperSettings(color=color)


@pytest.mark.parametrize(
    ("settings", "words"),
    [({"color": 5}, "color is 5; it must be a tuple"), ({"seed": -1}, "seed is -1"), ({"seed": 1.0}, "seed is 1.0")],
)
def test_settings_of_paper_of_another_type_are_an_error(settings, words):
    with pytest.raises(ValueError, match=words):
        PaperSettings(**settings)


def test_the_encoder_gets_the_settings_of_paper():
    assert CompressConfig(profile="paper").encoder_settings() == {}
    settings = CompressConfig(profile="paper", paper=PaperSettings(color=(3, 64))).encoder_settings()
    assert settings == {"color": (3, 64), "scale": (1, 128), "opacity": (1, 32), "seed": 0}
