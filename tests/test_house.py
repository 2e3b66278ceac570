"""The house: its package names are generic, so nobody else in the environment may provide them."""

import re
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.mark.parametrize("package", ["astratag", "schemas", "pipeline", "nodes"])
def test_no_foreign_distribution_provides_our_package(package):
    providers = set(packages_distributions().get(package, ()))
    assert providers <= {"astratag-relnav"}, f"{package} would be shadowed by {providers}"


def test_the_readme_s_python_can_be_run() -> None:
    """Each block compiles, what it imports is there, and it keeps its subscriber."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        compile(block, "README.md", "exec")
        exec("\n".join(line for line in block.splitlines() if re.match(r"(from|import) ", line)), {})
        assert not re.search(r"in \w+\.declare_subscriber", block), "it would be undeclared at once"
