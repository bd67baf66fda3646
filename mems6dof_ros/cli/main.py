"""`mems6dof`: one command, with subcommands that are imported when they are called."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Mapping, Sequence

from mems6dof_ros import __version__
from mems6dof_ros.allocator import keep_memory
from mems6dof_ros.errors import Mems6dofError

#: Subcommand to module, or to further subcommands. A module has ``add_parser(subparsers)``, which adds its
#: parser and sets its default ``run`` to a function of the arguments that returns the exit status.
COMMANDS: Mapping[str, str | Mapping[str, str]] = {
    "simulate": "mems6dof_ros.cli.simulate",
    "calibrate": "mems6dof_ros.cli.calibrate",
    "calibrate-field": "mems6dof_ros.cli.calibrate_field",
    "scan": "mems6dof_ros.cli.scan",
    "analyze": "mems6dof_ros.cli.analyze",
    "analyze-many": "mems6dof_ros.cli.analyze_many",
    "report": "mems6dof_ros.cli.report",
    "check": "mems6dof_ros.cli.check",
    "recover": "mems6dof_ros.cli.recover",
    "demo": "mems6dof_ros.cli.demo",
    "monitor": "mems6dof_ros.cli.monitor",
    "cameras": "mems6dof_ros.cli.cameras",
    "bench": "mems6dof_ros.cli.bench",
    "validate": {
        "stream": "mems6dof_ros.cli.validate_stream",
        "localization": "mems6dof_ros.cli.validate_localization",
        "calibration": "mems6dof_ros.cli.validate_calibration",
        "pose": "mems6dof_ros.cli.validate_pose",
        "cameras": "mems6dof_ros.cli.validate_cameras",
        "control": "mems6dof_ros.cli.validate_control",
        "monitor": "mems6dof_ros.cli.validate_monitor",
        "lab": "mems6dof_ros.cli.validate_lab",
    },
}

DESCRIPTION = "Particle tracking of a microsystem in three dimensions and six degrees of freedom."


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 2 for unusable input, 130 when interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    # Small linear algebra in many threads is five times slower than in one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    keep_memory()
    try:
        args = build_parser(arguments).parse_args(arguments)
        return int(args.run(args))
    except Mems6dofError as error:
        print(f"mems6dof: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mems6dof: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def build_parser(arguments: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser; where ``arguments`` name a subcommand, only that one is imported."""
    parser = argparse.ArgumentParser(prog="mems6dof", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"mems6dof {__version__}")
    _add_commands(parser, COMMANDS, arguments)
    return parser


def _add_commands(
    parser: argparse.ArgumentParser, commands: Mapping[str, str | Mapping[str, str]], arguments: Sequence[str]
) -> None:
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    chosen = arguments[0] if arguments else ""
    for name, target in commands.items():
        if chosen in commands and name != chosen:
            continue
        if isinstance(target, str):
            importlib.import_module(target).add_parser(subparsers)
        else:
            group = subparsers.add_parser(name, help="accuracy against simulation truth")
            _add_commands(group, target, arguments[1:])


if __name__ == "__main__":
    sys.exit(main())
