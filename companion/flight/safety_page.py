"""docs/safety.md, as far as it is made from the code: the state machine's diagram, reactions and limits.

    python -m companion.flight.safety_page          say whether the page is up to date
    python -m companion.flight.safety_page --write  bring it up to date

The page's own text stands around blocks between `<!-- NAME: made by … -->` and `<!-- end of NAME -->`.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from pathlib import Path

from companion.config.safety import QUANTITIES, RUNGS, Reaction, SafetyLimits
from companion.flight.ladder import mermaid
from companion.flight.sources import sources_table

PAGE = Path(__file__).parents[2] / "docs" / "safety.md"


def reactions_table() -> str:
    """The reactions with their docstrings."""
    source = inspect.getsource(Reaction)
    lines = ["| | reaction | what is done |", "|---|---|---|"]
    for reaction in Reaction:
        found = re.search(rf'{reaction.name} = \d\n    """(.*?)"""', source, re.DOTALL)
        assert found is not None, f"{reaction.name} has no docstring"
        lines.append(f"| {int(reaction)} | `{reaction.setting}` | {' '.join(found.group(1).split())} |")
    return "\n".join(lines) + "\n"


def limits_table() -> str:
    """The default limits: a row for each quantity, a column for each reaction."""
    limits = SafetyLimits()
    used = [
        r for r in RUNGS if any(limits.ladder(name).model_dump()[r.setting] != "off" for name in QUANTITIES)
    ]
    lines = [
        "| quantity | unit | " + " | ".join(r.setting for r in used) + " | what it is |",
        "|---|---|" + "---|" * len(used) + "---|",
    ]
    for name, quantity in QUANTITIES.items():
        rungs = {reaction: (at, for_s) for reaction, at, for_s in limits.ladder(name).rungs()}
        cells = []
        for reaction in used:
            if reaction not in rungs:
                cells.append("")
                continue
            at, for_s = rungs[reaction]
            sign = "<" if quantity.below else ">"
            cells.append(f"{sign} {at:g}" + (f" for {for_s:g} s" if for_s else ""))
        text = " ".join((SafetyLimits.model_fields[name].description or "").split())
        lines.append(f"| `{name}` | {quantity.unit} | " + " | ".join(cells) + f" | {text} |")
    return "\n".join(lines) + "\n"


def blocks() -> dict[str, str]:
    """Everything on the page that follows from the code alone."""
    return {
        "state machine": f"```mermaid\n{mermaid()}```\n",
        "reactions": reactions_table(),
        "limits": limits_table(),
        "sources": sources_table(),
    }


def with_block(page: str, name: str, content: str) -> str:
    """`page` with the block `name` replaced. Raises ValueError where the page has no such block."""
    pattern = re.compile(
        rf"(<!-- {re.escape(name)}: [^>]*-->\n).*?(<!-- end of {re.escape(name)} -->)", re.DOTALL
    )
    if not pattern.search(page):
        raise ValueError(f"{PAGE.name} has no block {name!r}")
    return pattern.sub(lambda found: f"{found.group(1)}\n{content}\n{found.group(2)}", page)


def put_block(name: str, content: str) -> None:
    """Replace one block of the page on disk."""
    PAGE.write_text(with_block(PAGE.read_text(encoding="utf-8"), name, content), encoding="utf-8")


def made(page: str) -> str:
    """`page` with all its blocks as the code has them."""
    for name, content in blocks().items():
        page = with_block(page, name, content)
    return page


def main() -> int:
    """Check or write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="bring the page up to date")
    arguments = parser.parse_args()
    page = PAGE.read_text(encoding="utf-8")
    if made(page) == page:
        return 0
    if arguments.write:
        PAGE.write_text(made(page), encoding="utf-8")
        return 0
    print(
        f"{PAGE.name} is not what the code says: python -m companion.flight.safety_page --write",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    sys.exit(main())
