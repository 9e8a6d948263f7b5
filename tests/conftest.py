"""What all tests share: where the real data lie, when they do, and no test against the clock."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# A busy machine is no failure.
settings.register_profile("unhurried", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("unhurried")

_DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real public data (``MAGTILES_TEST_DATA``); skips the test when absent."""
    folder = Path(os.environ.get("MAGTILES_TEST_DATA", _DEFAULT))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder} (set MAGTILES_TEST_DATA)")
    return folder
