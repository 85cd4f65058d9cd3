"""Bad input meets our own errors, as in a user's hands, where no shape checker stands before them."""

import jaxtyping
import pytest


@pytest.fixture
def unchecked(monkeypatch):
    """Shape checks off."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
