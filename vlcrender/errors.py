"""Exceptions of this package."""


class InputError(ValueError):
    """Invalid input. The message is one line: what, where, and what is allowed. The command line exits with 2."""
