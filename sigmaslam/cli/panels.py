"""Help of a command in panels, at most a screen: what experts alone need is told by `--help-all`."""

from typing import Annotated, Any

import typer
from typer.core import TyperCommand

PANELS = {
    "track": {
        "Input": ("calibration", "imu", "odometry", "mask", "frames"),
        "Output": ("out", "overwrite", "resume", "video"),
        "Tracker": ("frontend", "map", "track_object"),
        "Live": ("camera", "stream", "viewer", "serve"),
    }
}
"""Names of the parameters in each panel of a command's help; the rest is for experts."""


def _show_all(context: typer.Context, wanted: bool) -> None:
    if wanted:
        context.meta["all"] = True
        typer.echo(context.get_help())
        raise typer.Exit


HelpAll = Annotated[
    bool, typer.Option("--help-all", is_eager=True, callback=_show_all, help="Show all options and exit.")
]
"""Of a command that `PANELS` names."""


class PanelCommand(TyperCommand):
    """A command whose options stand under the titles of their panels, where it has some."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Arguments, panels, and the rest where it is asked for."""
        panels = PANELS.get(str(self.name))
        if panels is None:
            super().format_options(ctx, formatter)
            return
        left = {each.name: each for each in self.get_params(ctx)}
        arguments = tuple(name for name, each in left.items() if each.param_type_name == "argument")
        chosen = {"Arguments": arguments, **panels, "Help": ("help", "help_all")}
        shown = {title: [left.pop(name) for name in names] for title, names in chosen.items()}
        if "all" in ctx.meta:
            shown = {"For experts": list(left.values())} | shown
        for title, parameters in shown.items():
            with formatter.section(title):
                formatter.write_dl([record for each in parameters if (record := each.get_help_record(ctx)) is not None])
