"""Numbers of things in messages."""

from __future__ import annotations


def format_count(count: int, singular: str, plural: str | None = None) -> str:
    """Format a number of things with the words that follow it.

    Args:
        count: the number.
        singular: the words for one thing: a noun, perhaps with a verb.
        plural: the words for any other number. Default: `singular` with an "s" at its end.

    Example:
        >>> format_count(1, "photo"), format_count(2000, "photo"), format_count(0, "copy is left", "copies are left")
        ('1 photo', '2,000 photos', '0 copies are left')
    """
    words = singular if count == 1 else plural or f"{singular}s"
    return f"{count:,} {words}"
