"""Commands whose options act in the order in which they are given."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import click

_ORDER_KEY = "hyrfpack.cli.ordered"


class OrderedCommand(click.Command):
    """A command that keeps the order in which its options were given, for `options_in_order`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        _, _, parameters = self.make_parser(ctx).parse_args(args=list(args))
        ctx.meta[_ORDER_KEY] = [str(parameter.name) for parameter in parameters]
        return super().parse_args(ctx, args)


def options_in_order(ctx: click.Context, values: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name and value of each use of the repeatable options in `values`, in the order in which they were given.

    The value of an option that is only counted is None.
    """
    remaining_values = {name: iter(uses if isinstance(uses, tuple) else [None] * uses) for name, uses in values.items()}
    for name in ctx.meta[_ORDER_KEY]:
        if name in remaining_values:
            yield name, next(remaining_values[name])
