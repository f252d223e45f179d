"""How many examples property tests have: all of them in `make test-all`, a fifth of them in `make test`.

Outside CI Hypothesis draws other examples in each run, so that repeated runs of `make test` still find what is rare.
"""

from __future__ import annotations

from typing import Any

from hypothesis import settings

# Of the 100 examples that hypothesis draws by default.
QUICK_EXAMPLES_PERCENT = 20
MIN_EXAMPLES = 10
# No example has a deadline, which a busy machine would miss.
settings.register_profile("complete", deadline=None)
settings.register_profile("quick", deadline=None, max_examples=QUICK_EXAMPLES_PERCENT)


def use_profile(name: str) -> None:
    """Use the profile "complete" or "quick" for all tests whose modules are imported from now on."""
    settings.load_profile(name)


def examples(count: int, **options: Any) -> settings:
    """Return settings with `count` examples, or fewer of them in the quick profile."""
    in_profile = count * settings().max_examples // 100
    return settings(max_examples=min(count, max(in_profile, MIN_EXAMPLES)), **options)
