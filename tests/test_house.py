"""The house: its package names are generic, so nobody else in the environment may provide them."""

from importlib.metadata import packages_distributions

import pytest


@pytest.mark.parametrize("package", ["astratag", "schemas", "pipeline", "nodes"])
def test_no_foreign_distribution_provides_our_package(package):
    providers = set(packages_distributions().get(package, ()))
    assert providers <= {"astratag-relnav"}, f"{package} would be shadowed by {providers}"
