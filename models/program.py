"""What every program of the project has: its version."""

from typing import Annotated

import typer


def offer_version(app: typer.Typer, program: str) -> None:
    """Give `app` the option `--version`, which prints the version of `program` and ends."""

    def show(asked: bool) -> None:
        if asked:
            from importlib.metadata import version  # slow, and seldom asked for

            typer.echo(f"{program} {version('trueflight')}")
            raise typer.Exit

    @app.callback()
    def _(
        version: Annotated[
            bool, typer.Option("--version", help="Show the version and exit.", callback=show, is_eager=True)
        ] = False,
    ) -> None: ...
