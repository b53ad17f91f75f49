"""The command `companion`: finds the subcommand, turns errors of the user into one line and exit code 2."""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import sys
from collections.abc import Sequence
from types import ModuleType

from companion.config.errors import UserError

COMMANDS = (
    "fly",
    "check",
    "analyze",
    "compare",
    "identify",
    "replay",
    "recover",
    "export",
    "tune",
    "pose-source",
)
"""Each is a module of this package with `add_parser(subparsers)` and `run(arguments) -> int`."""

_EPILOG = """examples:
  companion fly --sitl px4                             fly the bundled stub, nothing else needed
  companion fly --endpoint udpin:0.0.0.0:14540         fly PX4's own simulation
  companion check --endpoint /dev/ttyACM0,921600       look at a real vehicle, change nothing
  companion analyze flights/last.mcap                  how well it flew
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="companion",
        description="Flies PX4 and ArduPilot multirotors over MAVLink from a companion computer.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"companion {_version()}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        _module(name).add_parser(subparsers)
    parsed = parser.parse_args(arguments)
    try:
        return int(_module(parsed.command).run(parsed))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except KeyboardInterrupt:
        return 130


def _version() -> str:
    try:
        return importlib.metadata.version("dtlannc-companion")
    except importlib.metadata.PackageNotFoundError:
        return "not installed, run from its sources"


def _module(command: str) -> ModuleType:
    return importlib.import_module(f"companion.cli.{command.replace('-', '_')}")


if __name__ == "__main__":
    sys.exit(main())
