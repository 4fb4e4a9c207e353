"""``modcal examples`` and ``modcal completion``: what an installation brings beside the verbs of work."""

from __future__ import annotations

import os
import shutil
import tomllib
from collections import Counter
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import click
from click.shell_completion import get_completion_class

from modcal_core.errors import BadCommand
from modcal_nodes.cli.console import Output, speaks

_KEPT = "share/modcal/"  # where pyproject.toml puts them, below the prefix of the installation
_FIRST = (
    "modcal import examples/tables/tracker.csv --urdf examples/robots/ur10.urdf --out my_arm",
    "modcal calibrate my_arm --tolerance-mm 0.2",
)


@click.command("examples")
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path), default=".")
@speaks()
def examples_command(folder: Path, output: Output) -> None:
    """Copy the example tables, robots, scripts and a recording into FOLDER. Default: the current one.

    They stand in FOLDER/examples and FOLDER/bags, as in a checkout: what README and documentation name is found there.
    """
    found = _shipped()
    names = sorted({name.partition("/")[0] for name in found})
    for name in names:
        if (folder / name).exists():
            raise BadCommand(str(folder / name), "is there already", "give another folder: modcal examples FOLDER")
    for name, source in found.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, folder / name)
    count = Counter(name.partition("/")[0] for name in found)
    here = "" if folder == Path() else f" in {folder}"
    said = ["Written: " + ", ".join(f"{folder / name} ({count[name]} files)" for name in names), f"Try{here}:"]
    output.result({"folder": str(folder), "files": sorted(found)}, [*said, *(f"  {one}" for one in _FIRST)])


def _shipped() -> dict[str, Path]:
    """Where each example is, by its path in a checkout: of an installed distribution, else of the checkout itself."""
    try:
        listed = files("modcal") or []
    except PackageNotFoundError:  # built by colcon: three packages, and no distribution
        listed = []
    found = {
        file.as_posix().partition(_KEPT)[2]: Path(str(file.locate()))
        for file in listed
        if _KEPT in file.as_posix() and file.suffix != ".pyc"  # pip lists what it compiled
    }
    if found := found or _of_checkout(Path(__file__).resolve().parents[5]):
        return found
    raise BadCommand("examples", "are not part of this installation", "take the folder examples of the checkout")


def _of_checkout(root: Path) -> dict[str, Path]:
    """The files that the distribution would bring, where this is a checkout."""
    stated = root / "pyproject.toml"
    if not stated.is_file() or not (root / "examples").is_dir():
        return {}
    data_files = tomllib.loads(stated.read_text(encoding="utf-8"))["tool"]["setuptools"]["data-files"]
    return {
        str(file.relative_to(root)): file
        for place, patterns in data_files.items()
        if place.startswith(_KEPT)
        for pattern in patterns
        for file in sorted(root.glob(pattern))
    }


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
