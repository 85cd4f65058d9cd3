"""One small city for all tests; module-wide, because a town takes seconds to build."""

import pytest

from openvocab_occ.datasets.city import City, Traversal
from openvocab_occ.datasets.city.keyframes import instant_of


@pytest.fixture(scope="session")
def city() -> City:
    return City(7)


@pytest.fixture(scope="session")
def drive(city: City) -> Traversal:
    return city.traversal(route=0, number=0)


@pytest.fixture(scope="session")
def instant(drive):
    return instant_of(drive, 8)
