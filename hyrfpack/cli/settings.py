"""Options that are made from the settings of a configuration class."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from hyrfpack.cli.types import SIZE, reject_non_finite
from hyrfpack.cli.wording import option_of_argument, use_option_names
from hyrfpack.config.settings import OneLine, OneOf, Range, Setting, list_settings

Command = TypeVar("Command", bound=Callable)

MAX_NAMED_INT = 9


def settings_options(config_class: type, *names: str) -> Callable[[Command], Command]:
    """Return a decorator that adds an option for each of the named settings of a configuration class.

    Name, type, limits, default and help follow from the definition of the setting. The command gets the values under
    the names of the settings.
    """
    settings = list_settings(config_class)

    def add(command: Command) -> Command:
        with_options: Any = command
        for name in reversed(names):
            with_options = _make_option(settings[name])(with_options)
        return with_options

    return add


def reject_two_sizes(*, max_gaussians: int | None, target_bytes: int | None, **others: object) -> None:
    """Reject --max-gaussians together with --target-size; `others` are settings that do not matter here.

    Raises:
        UsageError: both are given.
    """
    if max_gaussians is not None and target_bytes is not None:
        raise click.UsageError("--max-gaussians and --target-size each decide how large the model is; give one of them")


def _make_option(setting: Setting) -> Callable[[Command], Command]:
    name = option_of_argument(setting.name)
    help, default = use_option_names(setting.description), setting.default_description
    if setting.kind is bool:
        if setting.default is True:
            default = name.removeprefix("--")
        help += f"  [default: {default}]" if default else ""
        if setting.default is False:
            return click.option(name, setting.name, is_flag=True, help=help)
        return click.option(f"{name}/--no-{name.removeprefix('--')}", setting.name, default=setting.default, help=help)
    kind, metavar = _parameter_type(setting)
    return click.option(
        name,
        setting.name,
        type=kind,
        metavar=metavar,
        default=setting.default,
        show_default=setting.default is not None,
        callback=_choose_callback(setting),
        help=f"{help}  [default: {default}]" if default else help,
    )


def _choose_callback(setting: Setting) -> Callable[..., Any] | None:
    """Return what checks a value that the option's type accepts, if anything does."""

    def check(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        try:
            setting.check(value)
        except ValueError as error:
            raise click.BadParameter(str(error), ctx, param) from error
        return value

    return reject_non_finite if setting.kind is float else check if isinstance(setting.limits, OneLine) else None


def _parameter_type(setting: Setting) -> tuple[click.ParamType, str | None]:
    """Return the type of an option's values, and their name in the help; None for the name of the type."""
    limits = setting.limits
    if isinstance(limits, OneOf):
        return click.Choice(limits.words), None
    if not isinstance(limits, Range):
        return click.STRING, "NAME"
    if limits.unit == "bytes":
        return SIZE, "SIZE"
    unit = limits.unit.upper()
    if setting.kind is int:
        return click.IntRange(*limits.as_ints()), unit or _name_ints(*limits.as_ints())
    return click.FloatRange(limits.minimum, limits.maximum), unit or None


def _name_ints(minimum: int, maximum: int | None) -> str:
    """Return the name of the values of an option that takes ints: "3|4", "0-3" or "N"."""
    if maximum is None or maximum > MAX_NAMED_INT:
        return "N"
    return f"{minimum}{'|' if maximum - minimum == 1 else '-'}{maximum}"
