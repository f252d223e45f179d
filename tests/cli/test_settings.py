"""Options have the names, defaults and limits of the settings that they set, and the reference lists all of them."""

from __future__ import annotations

import re
from pathlib import Path

import click
import pytest
from commands import hyrfpack

from hyrfpack.cli import main
from hyrfpack.cli.settings import settings_options
from hyrfpack.cli.wording import option_of_argument
from hyrfpack.config.compress import CompressConfig
from hyrfpack.config.imports import ImportConfig
from hyrfpack.config.make import MakeConfig
from hyrfpack.config.settings import list_settings
from hyrfpack.config.train import TrainConfig

pytestmark = pytest.mark.unit
REFERENCE_PAGE = Path(__file__).parents[2] / "docs" / "reference" / "training.md"


def run(config_class: type, name: str, *arguments: str) -> click.testing.Result:
    """Run a command that has one option, for a setting, and prints its value."""
    command = click.command()(settings_options(config_class, name)(lambda **values: click.echo(repr(values[name]))))
    return click.testing.CliRunner().invoke(command, arguments)


@pytest.mark.parametrize(
    ("config_class", "name", "arguments", "printed"),
    [
        (TrainConfig, "steps", (), "3000"),
        (TrainConfig, "steps", ("--steps", "7"), "7"),
        (TrainConfig, "target_bytes", ("--target-size", "350kB"), "350000"),
        (TrainConfig, "target_bytes", (), "None"),
        (TrainConfig, "background", (), "None"),
        (TrainConfig, "background", ("--no-background",), "False"),
        (TrainConfig, "antialiased", ("--antialiased",), "True"),
        (TrainConfig, "preset", ("--preset", "street"), "'street'"),
        (TrainConfig, "ssim_weight", ("--ssim-weight", "0.5"), "0.5"),
        (ImportConfig, "psnr", ("--psnr", "40"), "40.0"),
        (CompressConfig, "profile", (), "'compact'"),
        (CompressConfig, "finetune_steps", ("--finetune", "500"), "500"),
        (CompressConfig, "prune", ("--no-prune",), "False"),
        (CompressConfig, "target_bytes", ("--target-size", "150kB"), "150000"),
        (CompressConfig, "max_psnr_drop", ("--max-psnr-drop", "0.1"), "0.1"),
    ],
)
def test_an_option_gives_the_value_of_its_setting(config_class, name, arguments, printed):
    assert run(config_class, name, *arguments).stdout.strip() == printed


@pytest.mark.parametrize(
    ("config_class", "name", "arguments"),
    [
        (TrainConfig, "steps", ("--steps", "0")),
        (TrainConfig, "seed", ("--seed", str(2**64))),
        (TrainConfig, "target_bytes", ("--target-size", "0")),
        (TrainConfig, "preset", ("--preset", "indoor")),
        (TrainConfig, "antialiased", ("--no-antialiased",)),
        (ImportConfig, "psnr", ("--psnr", "nan")),
        (CompressConfig, "finetune_steps", ("--finetune", "0")),
        (CompressConfig, "max_psnr_drop", ("--max-psnr-drop", "nan")),
        (CompressConfig, "max_psnr_drop", ("--max-psnr-drop", "inf")),
        (MakeConfig, "minutes", ("--minutes", "inf")),
        (CompressConfig, "profile", ("--profile", "zip")),
        (ImportConfig, "psnr", ("--psnr", "61")),
    ],
)
def test_a_value_outside_the_limits_of_a_setting_is_a_usage_error(config_class, name, arguments):
    assert run(config_class, name, *arguments).exit_code == 2


def test_the_help_has_the_description_the_unit_and_the_default():
    text = " ".join(hyrfpack("train", "--help").stdout.split())
    budget = "Budget: the number of Gaussians in the end, at most."
    assert f"--max-gaussians N {budget} [default: measured by pilot runs] [x>=1]" in text
    export = " ".join(hyrfpack("export", "--help").stdout.split())
    assert "--spz-version 3|4 Version of .spz files" in export and "[default: 4; 3<=x<=4]" in export
    assert "--sh-degree 0-3 Highest degree" in " ".join(hyrfpack("convert", "--help").stdout.split())
    assert "--target-size SIZE" in text and "--log2-table-size B" in text
    assert "--background / --no-background Train a background sphere. [default: by preset]" in text


def test_the_reference_lists_every_option_of_train_with_its_default():
    table = REFERENCE_PAGE.read_text().partition("## Options")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`--.*?) \| (.*?) \|", table, re.MULTILINE)
    listed = {flag for cell, _ in rows for flag in re.findall(r"--[a-z0-9-]+", cell)}
    options = {flag for option in main.commands["train"].params for flag in (*option.opts, *option.secondary_opts)}
    assert {flag for flag in options if flag.startswith("--")} - {"--output"} == listed
    defaults = {cell.split("`")[1].split()[0]: default.strip("`") for cell, default in rows}
    for setting in list_settings(TrainConfig).values():
        flag = option_of_argument(setting.name)
        if flag in defaults and setting.kind is not bool and setting.default is not None:
            assert defaults[flag] == str(setting.default)
