"""Help of commands with many options: in groups, and what few people need only behind `--help-all`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import click

_ALL = "sattools.help_all"
OTHER, RUN = "Files and configuration", "How it runs"
_RUN = ("verbose", "quiet", "progress", "threads", "max_memory", "allow_remote", "log_file")


class GroupedCommand(click.Command):
    """A command whose help shows its options in groups.

    Attributes:
        groups: names of parameters by the title of their group, in order; all others come last.
        expert: names of parameters that `--help` leaves out.
    """

    groups: ClassVar[Mapping[str, Sequence[str]]] = {}
    expert: frozenset[str] = frozenset()

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """See `click.Command.get_params`; `--help-all` stands beside `--help`."""
        return [*super().get_params(ctx), _help_all()]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """See `click.Command.format_options`."""
        every = bool(ctx.meta.get(_ALL))
        shown = {p.name: p for p in self.get_params(ctx) if every or p.name not in self.expert}
        titles = {name: title for title, names in self.groups.items() for name in names}
        sections: dict[str, list[tuple[str, str]]] = {title: [] for title in (*self.groups, OTHER, RUN)}
        for name, parameter in shown.items():
            record = parameter.get_help_record(ctx)
            if record is not None:
                sections[titles.get(str(name), RUN if name in _RUN else OTHER)].append(record)
        for title, rows in sections.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
        hidden = len(self.expert & {p.name for p in self.get_params(ctx)})
        if hidden and not every:
            formatter.write_paragraph()
            formatter.write_text(f"{hidden} more options for experts: {ctx.command_path} --help-all")


def _help_all() -> click.Option:
    def show(ctx: click.Context, parameter: click.Parameter, value: Any) -> None:
        if value and not ctx.resilient_parsing:
            ctx.meta[_ALL] = True
            click.echo(ctx.get_help(), color=ctx.color)
            ctx.exit()

    return click.Option(
        ["--help-all"],
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=show,
        help="Show all options, those for experts too, and exit.",
    )


__all__ = ["GroupedCommand"]
