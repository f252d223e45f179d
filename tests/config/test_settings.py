"""Settings are read from the annotations and the docstring of a class, and checked against them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated

import pytest

from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.export import ConvertConfig, ExportConfig
from hyrfpack.config.imports import ImportConfig
from hyrfpack.config.make import MakeConfig
from hyrfpack.config.poses import PosesConfig
from hyrfpack.config.settings import OneOf, Range, check_settings, list_settings
from hyrfpack.config.train import DensityConfig, TrainConfig

CONFIG_CLASSES = (
    CompressConfig,
    ConvertConfig,
    DensityConfig,
    ImportConfig,
    ExportConfig,
    MakeConfig,
    PosesConfig,
    TrainConfig,
)


@dataclass(frozen=True)
class BlurConfig:
    """Settings of a blur.

    Attributes:
        radius, border: radius of the filter, and
            of the border.
        edge: pixels outside; by `radius`. Default: by the picture.
        strength: strength of the filter.
        gamma: whether to blur in linear light.
        size: size of the picture.
    """

    radius: Annotated[int, Range(1, 99, unit="pixels")] = 3
    border: Annotated[int | None, Range(0)] = None
    edge: Annotated[str | None, OneOf(("wrap", "mirror"))] = None
    strength: Annotated[float, Range(0)] = 1.0
    gamma: bool | None = None
    size: tuple[int, int] = (1, 1)

    def __post_init__(self) -> None:
        check_settings(self)


def test_settings_have_the_kind_default_and_limits_of_their_annotation():
    settings = list_settings(BlurConfig)
    kinds = {name: (found.kind, found.optional, found.default) for name, found in settings.items()}
    assert kinds == {
        "radius": (int, False, 3),
        "border": (int, True, None),
        "edge": (str, True, None),
        "strength": (float, False, 1.0),
        "gamma": (bool, True, None),
    }
    assert settings["radius"].limits == Range(1, 99, "pixels") and settings["edge"].limits.words == ("wrap", "mirror")
    assert settings["gamma"].limits is None


def test_descriptions_are_the_entries_of_the_docstring_in_one_line():
    settings = list_settings(BlurConfig)
    assert settings["radius"].description == settings["border"].description
    assert settings["radius"].description == "Radius of the filter, and of the border."
    assert settings["edge"].description == "Pixels outside; by `radius`."
    assert settings["edge"].default_description == "by the picture"
    assert settings["radius"].default_description == ""


@pytest.mark.parametrize(
    "wrong",
    [
        *({"radius": value} for value in (0, 100, 1.5, None, True)),
        *({"border": value} for value in (-1, "3")),
        *({"edge": value} for value in ("round", 1)),
        *({"strength": value} for value in (-1.0, math.nan, math.inf, None)),
        *({"gamma": value} for value in (0, "yes")),
    ],
    ids=str,
)
def test_a_value_outside_the_limits_is_an_error_that_names_the_setting(wrong):
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))} is .*; it must be "):
        BlurConfig(**wrong)


def test_a_string_of_another_type_is_an_error_that_names_the_setting():
    with pytest.raises(ValueError, match="^title is 3; it must be a string$"):
        ExportConfig(title=3)


def test_the_limits_belong_to_the_range_and_none_is_allowed_where_the_annotation_says_so():
    BlurConfig(radius=1, border=None, edge=None, strength=0, gamma=None)
    BlurConfig(radius=99, border=0, edge="wrap", strength=1e9, gamma=True)


@pytest.mark.parametrize("config_class", CONFIG_CLASSES)
def test_every_setting_is_described_and_every_number_has_a_range(config_class):
    settings = list_settings(config_class)
    assert settings.keys() <= {field.name for field in fields(config_class)}
    for setting in settings.values():
        assert setting.description, setting.name
        assert setting.kind not in (int, float) or isinstance(setting.limits, Range), setting.name
        setting.check(setting.default)


def test_a_derived_class_has_the_settings_and_descriptions_of_its_base():
    assert list_settings(ExportConfig)["min_opacity"] == list_settings(ConvertConfig)["min_opacity"]


@pytest.mark.parametrize("crop", [(0, 0, 1, 1), (0, 0, 0, 1, 1, math.nan)])
def test_a_crop_that_is_no_box_is_an_error(crop):
    with pytest.raises(ValueError, match="^crop is .*; it must be six numbers"):
        ExportConfig(crop=crop)
