"""What a user can do wrong, said in one line."""


class InputError(ValueError):
    """Bad input. The message is one line naming what, where and what is allowed; the command line exits with 2."""
