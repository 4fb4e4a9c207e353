"""The page of the ``modcal`` command: every verb, its arguments and its options, as click knows them."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import click
from markup import code, prose, table

from modcal_nodes.cli.main import GROUPS, VERBS, modcal

INTRODUCTION = """# The command line

`modcal --help` lists the verbs, and `modcal VERB --help` prints the same as this page. Every verb ends with exit code 0
on success; 2 when the input cannot be used, with one line on stderr that says what offends, the limit and the
remedy, and nothing written (`modcal fleet` excepted, which writes what could be done); 130 when it was interrupted; 1
when modcal itself is at fault, with a traceback; 3 when it is done, and a tolerance that was asked for is not met or
cannot be told.

* `--json` prints the result as JSON in place of tables, `-v` says on stderr what takes how long.
* The first line names the arm that was taken, `arm: base_link → tool0, 6 joints`, and, where another arm has as many
  joints, the option that takes that one. The default tip is the link behind most recorded joints, short of a gripper.
* The lines below a table say what its columns mean; the last lines name every file that was written.

**Completion** of verbs, options, choices and files, by a script that Click writes:

    modcal completion bash >> ~/.bashrc
    modcal completion zsh >> ~/.zshrc                                # after compinit
    modcal completion fish > ~/.config/fish/completions/modcal.fish

What `modcal calibrate` and `modcal evaluate` write: [fields of report.json](../report.md#fields-of-reportjson)."""


def page() -> str:
    """Text of the page."""
    listing = table(
        ("", "verb", ""),
        (
            ("" if i else group, f"[`{verb}`](#modcal-{verb})", prose(VERBS[verb][1]))
            for group, verbs in GROUPS.items()
            for i, verb in enumerate(verbs)
        ),
    )
    root = click.Context(modcal, info_name="modcal", **modcal.context_settings)
    parts = [INTRODUCTION, listing]
    for verb in modcal.list_commands(root):
        command = modcal.get_command(root, verb)
        assert command is not None
        parts += _command(command, click.Context(command, info_name=verb, parent=root), 2)
    return "\n\n".join(part for part in parts if part) + "\n"


def _command(command: click.Command, context: click.Context, level: int) -> Iterator[str]:
    yield f"{'#' * level} {context.command_path}"
    usage = " ".join(command.collect_usage_pieces(context))
    yield f"    {context.command_path} {usage}"
    yield from _paragraphs(command.help or "")
    yield _options(command, context)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            below = command.get_command(context, name)
            assert below is not None
            yield from _command(below, click.Context(below, info_name=name, parent=context), level + 1)


def _paragraphs(text: str) -> Iterator[str]:
    """Paragraphs of a help text; one that click leaves unwrapped (behind a backspace) stays as it is."""
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        if paragraph.startswith("\b\n"):
            yield "\n".join("    " + line for line in paragraph[2:].splitlines())
        else:
            yield prose(paragraph)


def _options(command: click.Command, context: click.Context) -> str:
    records = [
        (parameter, record)
        for parameter in command.get_params(context)
        if (record := parameter.get_help_record(context)) is not None
        # the usage line has arguments that nothing is said of, and every verb has --help
        and (record[1] or isinstance(parameter, click.Option))
        and "--help" not in parameter.opts
    ]
    if not records:
        return ""
    rows = [(code(flags) + (", required" if p.required else ""), prose(said)) for p, (flags, said) in records]
    return table(("option", ""), rows)
