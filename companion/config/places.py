"""Where this program keeps what it has to remember from run to run."""

from __future__ import annotations

import os
from pathlib import Path


def state_folder() -> Path:
    """`$XDG_STATE_HOME/dtlannc-companion`, by default below `~/.local/state`. Not made here."""
    home = os.environ.get("XDG_STATE_HOME") or os.path.join(os.path.expanduser("~"), ".local", "state")
    return Path(home) / "dtlannc-companion"
