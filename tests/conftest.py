"""Fixtures of every test: seeds, the real data beside the project, small scenes."""

from pathlib import Path

import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of real data; the test is skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip("the real data (../shared/data) is not on this machine")
    return DATA.resolve()


@pytest.fixture(scope="session")
def keyframe(data: Path) -> Path:
    return data / "nuscenes_keyframe"
