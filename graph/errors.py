"""What a user did wrong, said in one sentence."""


class UserError(Exception):
    """Bad input: the message says what was given, what was wanted and what exists. Shown without a traceback."""
