"""The one exception that ends in a clear line for the user instead of a traceback."""

from __future__ import annotations


class UserError(Exception):
    """Something the user gave is wrong. The message names the place and the remedy; commands exit with 2."""
