"""``modcal completion``: the script by which a shell completes verbs, options and files, as Click writes it."""

from __future__ import annotations

import os
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from modcal_core.errors import BadCommand

_SHELLS = ("bash", "zsh", "fish")


@click.command("completion")
@click.argument("shell", type=click.Choice(_SHELLS), required=False)
@click.pass_context
def completion_command(ctx: click.Context, shell: str | None) -> None:
    """Print the script by which SHELL completes verbs, options, choices and files. Default: the shell of $SHELL.

    \b
    bash   modcal completion bash >> ~/.bashrc
    zsh    modcal completion zsh >> ~/.zshrc       (after compinit)
    fish   modcal completion fish > ~/.config/fish/completions/modcal.fish
    """  # noqa: D301  # Click takes this backspace for "leave the lines as they are"
    chosen = shell or Path(os.environ.get("SHELL", "")).name
    made = get_completion_class(chosen) if chosen in _SHELLS else None
    if made is None:
        raise BadCommand(f"shell '{chosen}'", "has no completion script", f"give one of {', '.join(_SHELLS)}")
    click.echo(made(ctx.find_root().command, {}, "modcal", "_MODCAL_COMPLETE").source())
