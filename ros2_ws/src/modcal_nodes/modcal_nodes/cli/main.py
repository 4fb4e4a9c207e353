"""The ``modcal`` command: one verb a file, and one way to fail.

Exit 0: done. Exit 3: done, but a tolerance that was asked for is not met or cannot be told. Exit 2: the input cannot be
used; one line on stderr says what offends, the limit and the remedy, and nothing has been written. Exit 1: our own
fault, with the traceback that a bug report needs.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module

import click
from click.shell_completion import CompletionItem

import modcal_core
from modcal_core.errors import ModcalError, plain
from modcal_nodes.one_thread import limit_blas

# Verbs in the order of work: the module in which VERB_command is, and what stands in the list. Only the verb that is
# asked for is imported: NumPy, SciPy and the readers of bags take a second or two, which a request for help should not.
GROUPS = {
    "Begin": {"examples": ("examples", "Copy the examples that the documentation uses into a folder.")},
    "Prepare a measurement": {
        "sensitivity": ("plan", "Report which parameters of an arm matter most."),
        "plan": ("plan", "Choose stations: for an accuracy, or to tell explanations apart."),
        "target": ("target", "Write a board to print for calibrating with a camera."),
        "payload": ("limits", "Weigh what the arm carries by the torques of its joints at rest."),
        "limits": ("limits", "Compute how fast each joint may accelerate with this payload."),
        "simulate": ("measure", "Record a simulated cell with errors that its model lacks."),
    },
    "Measure": {"measure": ("measure", "Measure station after station until an accuracy is proven.")},
    "Get and look at a recording": {
        "import": ("tables", "Convert CSV tables into a bag, or a kinematic table into a URDF."),
        "info": ("info", "Show what is in BAG, what it can be used for, and what looks wrong."),
        "repair": ("info", "Repair a truncated bag."),
    },
    "Calibrate": {
        "calibrate": ("calibrate", "Identify the arm from BAG, and find what its model lacks."),
        "evaluate": ("calibrate", "Score a frozen CALIBRATION on another BAG."),
        "check": ("calibrate", "Tell what has changed since CALIBRATION, from ten new stations."),
        "sentinel": ("history", "Tell whether an arm has changed, from ordinary recordings of its work."),
        "history": ("history", "Show what grows over a robot's calibrations and checks."),
        "compare": ("history", "Compare two calibrations or reports: what differs, does it matter?"),
        "fleet": ("fleet", "Calibrate many recordings, and put the results in one table."),
    },
    "Use the result": {
        "export": ("tables", "Write an arm's kinematics as a CPC, DH or modified DH table, or a URDF."),
        "measure-object": ("limits", "Measure the box in the gripper, and where to put it down."),
    },
    "Running nodes": {
        "watch": ("running", "Show the status of all nodes of a cell, live."),
        "call": ("running", "Call a service or an action of a node, and print its answer."),
        "play": ("running", "Publish the messages of BAG again."),
    },
    "Doors and drawers": {
        "articulate": ("doors", "Identify how the handle in BAG moves, and write it as a URDF."),
        "door": ("doors", "Open a simulated door or drawer with the nodes, and report."),
    },
    "Arms made of modules": {
        "synthesize": ("assemble", "Find an assembly of modules for a task."),
        "assemble": ("assemble", "Build a robot description from a list of modules."),
        "modules": ("assemble", "Learn the errors of physical modules over several assemblies."),
    },
    "Shell": {"completion": ("examples", "Print the script for completion in bash, zsh or fish.")},
}
VERBS = {verb: found for verbs in GROUPS.values() for verb, found in verbs.items()}


class _Verbs(click.Group):
    """Verbs that are imported when they are asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the verbs, in the order of work."""
        return list(VERBS)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The verb that is asked for; of one that is not there, which it is like."""
        if args[0] not in VERBS and not args[0].startswith("-"):
            like = get_close_matches(args[0], VERBS, 2)
            meant = f" Did you mean {' or '.join(like)}?" if like else ""
            raise click.UsageError(f"No such command '{args[0]}'.{meant}", ctx)
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of a verb, or None."""
        if cmd_name not in VERBS:
            return None
        module = import_module(f"modcal_nodes.cli.{VERBS[cmd_name][0]}")
        found = getattr(module, f"{cmd_name.replace('-', '_')}_command")
        assert isinstance(found, click.Command)
        return found

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of verbs."""
        wide = max(map(len, VERBS))
        for group, verbs in GROUPS.items():
            with formatter.section(group):
                formatter.write_dl([(verb.ljust(wide), said) for verb, (_, said) in verbs.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """The verbs that begin so, and the options of ``modcal`` itself, none of them being imported."""
        verbs = [v for v in self.list_commands(ctx) if v.startswith(incomplete)]
        own = click.Command.shell_complete(self, ctx, incomplete)
        return [*(CompletionItem(verb, help=VERBS[verb][1]) for verb in verbs), *own]


@click.group(
    cls=_Verbs, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110, "show_default": True}
)
@click.version_option(modcal_core.__version__, prog_name="modcal")
def modcal() -> None:
    """Calibrate robot arms from joint positions and tracker readings.

    Finds what an arm's model gets wrong, corrects it, and reports the error that is left on held-out data.
    """


def run(arguments: Sequence[str] | None = None) -> int:
    """Exit code of the command with these arguments (default: those of the process)."""
    try:
        code = modcal.main(None if arguments is None else list(arguments), prog_name="modcal", standalone_mode=False)
        return int(code or 0)
    except ModcalError as error:
        return _refuse(str(error))
    except click.ClickException as error:
        # a bare `modcal` asks for help; its text is not an error message
        if isinstance(error, click.exceptions.NoArgsIsHelpError):
            click.echo(error.format_message())
            return 0
        where = error.ctx.command_path if isinstance(error, click.UsageError) and error.ctx is not None else ""
        return _refuse(error.format_message() + (f" See: {where} --help" if where else ""))
    except OSError as error:
        where = error.filename or "file system"
        return _refuse(f"{where}: {error.strerror or error}: check the path, its permissions and the space left")
    except (click.Abort, KeyboardInterrupt):
        return 130
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if (remedy := _source_of(missing)) is None:
            return _fault()
        words = sys.argv[1:] if arguments is None else arguments
        verb = next((word for word in words if word in VERBS), "modcal")
        return _refuse(f"{verb}: needs {missing}, which is not installed: {remedy}")
    except Exception:
        return _fault()


def _fault() -> int:
    import traceback

    traceback.print_exc()
    click.echo("modcal: this is a fault of modcal; please report it with the lines above", err=True)
    return 1


# Where a module comes from that not every installation has: an extra of the distribution, or a package beside ROS from
# apt, which has none, or an older one
_SOURCES = {
    "mujoco": "modcal[simulate]",
    "pyarrow": "modcal[fleet]",
    "distributed": "modcal[fleet]",
    "cv2": "opencv-python-headless",
    "fpdf": "fpdf2",
}
_ROS = ("rclpy", "ament_index_python", "launch", "launch_ros", "rosidl_runtime_py", "rosgraph_msgs", "lifecycle_msgs")


def _source_of(module: str) -> str | None:
    """Where a module comes from that not every installation has; None for any other."""
    if module in _SOURCES:
        return f"pip install '{_SOURCES[module]}'"
    if module in _ROS or module.endswith(("_msgs", "_interfaces", "_srvs")):
        return "source a ROS 2 installation (/opt/ros/jazzy/setup.bash); only call, door, play and watch need one"
    return None


def _refuse(line: str) -> int:
    click.echo("modcal: " + plain(" ".join(line.split())), err=True)
    return 2


def main() -> None:
    """Entry point of the executable."""
    limit_blas()
    sys.exit(run())


if __name__ == "__main__":
    main()
