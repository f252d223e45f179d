"""The error that the decoders of this package raise.

They do not know which file the data comes from; the reader of the file adds its name to the message.
"""


class DamagedDataError(ValueError):
    """Coded data is truncated, damaged or inconsistent."""
