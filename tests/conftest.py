"""Profiles of hypothesis for the whole of the tests."""

from __future__ import annotations

from hypothesis import Phase, settings

# A mutant is dead at the first example that fails: nothing is made smaller, nothing kept, every run the same.
settings.register_profile(
    "mutation", phases=[Phase.explicit, Phase.generate], database=None, derandomize=True
)
