"""The command `companion`: finds the subcommand, turns errors of the user into one line and exit code 2.

Imported are only modules that Python has loaded anyhow, the rest when the command runs: Ctrl-C while libraries load is
an end like any other, and no traceback.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

COMMANDS = (
    "fly",
    "standby",
    "engage",
    "serve",
    "check",
    "analyze",
    "compare",
    "identify",
    "adopt",
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
    """Run the command line; returns the exit code, which no trouble with printing changes."""
    try:
        from companion.cli.output import results_and_words

        with results_and_words():
            return _run(arguments)
    except KeyboardInterrupt:
        return 130


def _run(arguments: Sequence[str] | None) -> int:
    import argparse

    from companion.config.errors import UserError

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
    except Exception:  # said here, as Python would, where a terminal that takes nothing holds nobody up
        import traceback

        traceback.print_exc()
        return 1


def _version() -> str:
    import importlib.metadata

    try:
        return importlib.metadata.version("dtlannc-companion")
    except importlib.metadata.PackageNotFoundError:
        return "not installed, run from its sources"


def _module(command: str) -> ModuleType:
    import importlib

    return importlib.import_module(f"companion.cli.{command.replace('-', '_')}")


if __name__ == "__main__":
    sys.exit(main())
