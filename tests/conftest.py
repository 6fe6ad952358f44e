"""Double precision for all tests: tolerances are then about formulas, not about rounding."""

import jax
import pytest

jax.config.update("jax_enable_x64", True)


@pytest.fixture
def key():
    return jax.random.key(7)
