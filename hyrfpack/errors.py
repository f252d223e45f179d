"""The one family of errors that a user can cause.

Each message is one sentence that says what is wrong, where, and what to do. The command line prints it and
exits with code 2; anything else that escapes is a bug of ours and keeps its traceback.
"""


class HyrfError(Exception):
    """Something about the input or the request is wrong and the user can mend it."""


class HyrfDataError(HyrfError):
    """Photos, poses or points on disk cannot be used as they are."""


class HyrfFormatError(HyrfError):
    """A `.hyrf` file is damaged, hostile, or made by a newer version."""


class HyrfTrainingError(HyrfError):
    """Training cannot start or cannot go on (a loss that is not finite, a checkpoint that does not fit)."""
