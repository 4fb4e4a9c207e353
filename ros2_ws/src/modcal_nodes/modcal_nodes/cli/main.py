"""The ``modcal`` command: one verb a file, and one way to fail.

Exit 0: done. Exit 2: the input cannot be used; one line on stderr says what offends, the limit and the remedy, and
nothing has been written. Exit 1: our own fault, with the traceback that a bug report needs.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence

import click

import modcal_core
from modcal_core.errors import ModcalError
from modcal_nodes.cli.articulate import articulate_command
from modcal_nodes.cli.assemble import assemble_command, modules_command
from modcal_nodes.cli.calibrate import calibrate_command, evaluate_command
from modcal_nodes.cli.plan import plan_command
from modcal_nodes.cli.recordings import import_command, info_command
from modcal_nodes.cli.repair import repair_command
from modcal_nodes.cli.synthesize import synthesize_command


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(modcal_core.__version__, prog_name="modcal")
def modcal() -> None:
    """Make a robot arm tell the truth about where its tool is.

    Reads bags of joint states and tracker readings, finds what the arm's model gets wrong, and says what is left.
    """


for _command in (
    calibrate_command,
    evaluate_command,
    plan_command,
    import_command,
    info_command,
    repair_command,
    assemble_command,
    modules_command,
    articulate_command,
    synthesize_command,
):
    modcal.add_command(_command)


def run(arguments: Sequence[str] | None = None) -> int:
    """Exit code of the command with these arguments (default: those of the process)."""
    try:
        code = modcal.main(args=None if arguments is None else list(arguments), standalone_mode=False)
        return int(code or 0)
    except ModcalError as error:
        return _refuse(str(error))
    except click.ClickException as error:
        # a bare `modcal` asks for help; its text is not an error message
        if isinstance(error, click.exceptions.NoArgsIsHelpError):
            click.echo(error.format_message())
            return 0
        return _refuse(error.format_message())
    except OSError as error:
        where = error.filename or "file system"
        return _refuse(f"{where}: {error.strerror or error}: check the path, its permissions and the space left")
    except (click.Abort, KeyboardInterrupt):
        return 130
    except Exception:
        traceback.print_exc()
        click.echo("modcal: this is a fault of modcal; please report it with the lines above", err=True)
        return 1


def _refuse(line: str) -> int:
    click.echo("modcal: " + " ".join(line.split()), err=True)
    return 2


def main() -> None:
    """Entry point of the executable."""
    sys.exit(run())


if __name__ == "__main__":
    main()
