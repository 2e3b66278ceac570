"""Compiled functions: what they take, and where their machine code is kept."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import astratag
from astratag import compiled
from astratag.normal import dot, factored, inverse, ranked

PACKAGE = Path(astratag.__file__).parent


def test_another_type_of_array_is_refused():
    with pytest.raises(TypeError, match="No matching definition"):
        dot(np.ones(3, dtype=np.float32), np.ones(3))
    with pytest.raises(TypeError, match="No matching definition"):
        dot(np.ones((3, 2))[:, 0], np.ones(3))


def test_inverse_against_numpy():
    for seed in range(20):
        A = np.random.default_rng(seed).normal(size=(12, 8))
        S = A.T @ A
        np.testing.assert_allclose(
            inverse(factored(S)), np.linalg.inv(S), rtol=1e-9, atol=1e-9 * np.abs(np.linalg.inv(S)).max()
        )


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=50), st.data())
def test_ranks_against_numpy(values, data):
    rank = data.draw(st.integers(0, len(values) - 1))
    assert ranked(np.array(values), rank) == np.sort(values)[rank]


def test_what_has_no_inverse_is_answered_with_nan():
    assert not np.isfinite(inverse(factored(np.diag([1.0, 0.0])))).all()
    assert np.isnan(inverse(factored(np.full((2, 2), np.nan)))).all()


def test_code_is_kept_under_a_digest_of_what_it_draws_on(tmp_path):
    """A constant in a file without compiled functions counts; a file that none of them imports does not."""
    package = tmp_path / "astratag"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    before = compiled._sources(package)
    assert len(before) > 10
    (package / "detector.py").write_text("")
    assert compiled._sources(package) == before
    (package / "edges.py").write_text(
        (package / "edges.py").read_text().replace("END_MARGIN = 0.08", "END_MARGIN = 0.1")
    )
    assert compiled._sources(package) != before


def test_code_of_other_versions_is_removed(tmp_path, monkeypatch):
    package = tmp_path / "astratag"
    old = package / "__pycache__" / f"{compiled.PREFIX}old"
    old.mkdir(parents=True)
    (package / "compiled.py").write_text("")
    monkeypatch.setattr(compiled, "__file__", str(package / "compiled.py"))
    kept = compiled._folder.__wrapped__()
    assert kept.is_dir() and kept.parent == old.parent and not old.exists()


def test_where_sources_cannot_be_written_beside_the_users_cache_is_used(tmp_path, monkeypatch):
    package = tmp_path / "astratag"
    package.mkdir()
    (package / "__pycache__").write_text("no folder")
    (package / "compiled.py").write_text("")
    monkeypatch.setattr(compiled, "__file__", str(package / "compiled.py"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert compiled._folder.__wrapped__().parent == tmp_path / "cache" / "astratag"
    monkeypatch.setenv("XDG_CACHE_HOME", str(package / "__pycache__"))
    with pytest.raises(OSError, match="nowhere to keep compiled functions"):
        compiled._folder.__wrapped__()
