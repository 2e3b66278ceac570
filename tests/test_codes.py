"""The code families: field laws, distances recounted, what decoding must find, refuse and never get wrong."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import stats

from astratag.codes import (
    FAMILIES,
    Codeword,
    Reading,
    Rejected,
    acceptance_threshold,
    effective_cells,
    gf64,
    hamming_false_accept_rate,
    hamming_threshold,
    search_instance,
    select_identities,
)
from astratag.codes.acceptance import chance_of_correlation
from astratag.codes.algebraic import decode_symbols
from astratag.codes.soft import correlations
from astratag.codes.words import REGION_CELLS, LinearMap, pack, unpack
from astratag.dictionary import load_dictionary
from astratag.geometry import CELLS, REGIONS, turn_clockwise

IDENTITIES = {"astratag48h16": 1008, "astratag48h12": 64512, "astratag48h9": 4193280}
every_family = pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES.keys())
elements = st.integers(0, gf64.ORDER - 1)
families = st.sampled_from(list(FAMILIES.values()))
seeds = st.integers(0, 2**32 - 1)


# --- the field


def carryless_product(a: int, b: int) -> int:
    """Multiply as polynomials over GF(2), then divide by x^6 + x + 1: school arithmetic, no tables."""
    product = 0
    for bit in range(6):
        product ^= (a << bit) * (b >> bit & 1)
    for bit in range(10, 5, -1):
        product ^= (0b1000011 << (bit - 6)) * (product >> bit & 1)
    return product


def test_products_are_those_of_polynomials_modulo_the_modulus():
    a, b = np.meshgrid(np.arange(64), np.arange(64))
    expected = [
        [carryless_product(int(x), int(y)) for x, y in zip(*rows, strict=True)] for rows in zip(a, b, strict=True)
    ]
    np.testing.assert_array_equal(gf64.multiply(a, b), expected)


def test_inverses():
    nonzero = np.arange(1, 64)
    assert (gf64.multiply(nonzero, gf64.inverse(nonzero)) == 1).all()
    with pytest.raises(ZeroDivisionError):
        gf64.inverse([3, 0])


@given(elements, elements)
def test_the_eighth_power_is_an_automorphism_of_order_two(a, b):
    assert gf64.power(a ^ b, 8) == gf64.power(a, 8) ^ gf64.power(b, 8)
    assert gf64.power(gf64.multiply(a, b), 8) == gf64.multiply(gf64.power(a, 8), gf64.power(b, 8))
    assert gf64.power(gf64.power(a, 8), 8) == a


polynomials = st.lists(elements, max_size=9).map(gf64.trim)


@given(polynomials, polynomials.filter(len))
def test_division_of_polynomials_undoes_multiplication(p, q):
    quotient, remainder = gf64.divide_poly(p, q)
    assert len(remainder) < len(q)
    np.testing.assert_array_equal(gf64.add_poly(gf64.multiply_poly(quotient, q), remainder), p)


@given(st.permutations(range(64)), polynomials)
def test_interpolation_finds_the_polynomial(points, p):
    at = np.array(points[: max(len(p), 1)])
    np.testing.assert_array_equal(gf64.interpolate(at, gf64.evaluate(p, at)), p)


@given(st.lists(st.integers(0, 2**CELLS - 1), min_size=2, max_size=9), seeds)
def test_words_and_linear_maps(words, seed):
    np.testing.assert_array_equal(pack(unpack(np.array(words, dtype=np.uint64))), words)
    message = seed % (1 << len(words))
    total = 0
    for place, word in enumerate(words):
        total ^= word * (message >> place & 1)
    assert LinearMap(words)(message) == total


# --- the families


@every_family
def test_the_frozen_family_is_what_its_seed_finds(family):
    assert search_instance(family.k, family.seed) == family


def test_the_search_knows_three_dimensions():
    with pytest.raises(ValueError, match=r"k must be one of \[2, 3, 4\], got 5"):
        search_instance(5, 0)


FROZEN_WORDS = {
    "astratag48h16": ["b3dd9618f001", "381bc9ba8002", "c79806f0c44c", "6135a9e5fb34"],
    "astratag48h12": ["909436440001", "d851ebcc0002", "723a2be226df", "cac55cf5ffbe"],
    "astratag48h9": ["bb1abd000001", "786ebf000002", "b1cec9a25f2b", "daa9d7f7ffff"],
}


@every_family
def test_signatures_never_change(family):
    """Markers are in orbit: these are the codes of the first two ids, the middle one and the last."""
    ids = [0, 1, len(family) // 2, len(family) - 1]
    assert [f"{word:012x}" for word in pack(family.signatures(ids)).tolist()] == FROZEN_WORDS[family.name]


@every_family
def test_every_turned_codeword_is_a_codeword(family):
    cells = unpack(np.array(family.generator, dtype=np.uint64))  # enough, the code being linear
    turned = turn_clockwise(cells)
    np.testing.assert_array_equal(unpack(family.encoder(family.messages(turned))), turned)


@every_family
def test_codewords_are_values_of_polynomials(family):
    """Against the definition: any coefficients, evaluated at the eight points, are the codeword of their message."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        polynomial = rng.integers(0, 64, family.k)
        cells = family.cells(gf64.evaluate(polynomial, family.points))
        np.testing.assert_array_equal(family.symbols(cells), gf64.evaluate(polynomial, family.points))
        np.testing.assert_array_equal(unpack(family.encoder(family.messages(cells))), cells)


@every_family
def test_least_distance_recounted_over_all_codewords(family):
    """The code is linear and holds all turns, so the least distance of two readings is the least weight."""
    assert family.encoder.least_weight() == family.distance
    assert len(np.unique(family.points)) == REGIONS


def test_least_distance_recounted_between_all_readings_of_the_smallest_family():
    """The same with nothing assumed: all 4032 readings against each other."""
    family = FAMILIES["astratag48h16"]
    upright = family.signatures(np.arange(len(family)))
    words = np.concatenate([pack(turn_clockwise(upright, k)) for k in range(4)])
    distances = np.bitwise_count(words[:, None] ^ words)
    assert np.unique(distances[~np.eye(len(words), dtype=bool)])[0] == 16


@every_family
def test_identities_are_the_orbits_of_four(family):
    assert len(family) == IDENTITIES[family.name] == (64**family.k - 64 ** (family.k // 2 + family.k % 2)) // 4


@given(families, seeds, st.integers(0, 3))
def test_identities_there_and_back(family, seed, quarter_turns):
    marker_id = seed % len(family)
    upright = family.signatures(marker_id)
    assert family.identify(turn_clockwise(upright, quarter_turns)) == (marker_id, quarter_turns)
    turns = [int(family.messages(turn_clockwise(upright, k))) for k in range(4)]
    assert turns[0] == min(turns)
    assert len(set(turns)) == 4


@every_family
def test_refuses_ids_outside_the_family(family):
    for outside in (-1, len(family)):
        with pytest.raises(ValueError, match=f"{family.name} has ids 0-{len(family) - 1}, got {outside}"):
            family.signatures([0, outside])


# --- algebraic decoding

errors_and_erasures = [
    (family, wrong, erased)
    for family in FAMILIES.values()
    for erased in range(REGIONS - family.k + 1)
    for wrong in range((REGIONS - family.k - erased) // 2 + 1)
]


@pytest.mark.parametrize(
    ("family", "wrong", "erased"),
    errors_and_erasures,
    ids=[f"{family.name}-{wrong}-wrong-{erased}-missing" for family, wrong, erased in errors_and_erasures],
)
@settings(max_examples=20)
@given(seed=seeds, quarter_turns=st.integers(0, 3))
def test_corrects_wrong_and_missing_regions(family, wrong, erased, seed, quarter_turns):
    """Any t regions wrong in any way and any e missing, 2 t + e <= 8 - k: always the right marker."""
    rng = np.random.default_rng(seed)
    marker_id = int(rng.integers(len(family)))
    order = rng.permutation(REGIONS)
    cells = turn_clockwise(family.signatures(marker_id), quarter_turns)
    for region in order[:wrong]:
        cells[REGION_CELLS[region]] ^= unpack(rng.integers(1, 64, dtype=np.uint64))[:6]
    missing = order[wrong : wrong + erased]
    cells[REGION_CELLS[missing]] = rng.integers(0, 2, (erased, 6))
    found = family.correct(cells, np.isin(np.arange(REGIONS), missing))
    assert found == Codeword(marker_id, quarter_turns, tuple(sorted(order[:wrong].tolist())))


@given(families, st.lists(elements, min_size=REGIONS, max_size=REGIONS), st.integers(0, REGIONS))
def test_beyond_the_radius_it_refuses_or_finds_one_as_near(family, received, missing):
    n = REGIONS - missing
    points = family.points[:n]
    found = decode_symbols(np.array(received[:n], dtype=np.int64), points, family.k)
    if isinstance(found, Rejected):
        assert "regions" in found.reason
    else:
        assert len(found) <= family.k
        assert 2 * (gf64.evaluate(found, points) != received[:n]).sum() <= n - family.k


@every_family
def test_refuses_when_too_few_regions_are_left(family):
    erased = np.arange(REGIONS) >= family.k - 1
    assert family.correct(family.signatures(0), erased) == family.decode(family.signatures(0) * 1.0, erased)
    assert family.correct(family.signatures(0), erased) == Rejected(
        f"{family.k - 1} regions are left and {family.k} are needed"
    )


@every_family
def test_refuses_what_looks_the_same_after_half_a_turn(family):
    constant = family.cells(np.full(REGIONS, 37))
    np.testing.assert_array_equal(turn_clockwise(constant, 2), constant)
    assert family.identify(constant) is None
    for refusal in (family.correct(constant), family.decode(constant.astype(float))):
        assert isinstance(refusal, Rejected)
        assert "half a turn" in refusal.reason


# --- soft decoding


@given(families, seeds, st.integers(0, 3), st.floats(-2, 2), st.floats(-200, 200))
def test_decodes_at_any_gain_and_level_with_regions_covered(family, seed, quarter_turns, log_gain, level):
    """Up to 8 - k regions may be missing; the fewer cells are left, the less chance is excluded."""
    rng = np.random.default_rng(seed)
    marker_id = int(rng.integers(len(family)))
    erased = np.isin(np.arange(REGIONS), rng.permutation(REGIONS)[: rng.integers(REGIONS - family.k + 1)])
    kept = np.ones(CELLS, bool)
    kept[REGION_CELLS[erased]] = False
    code = turn_clockwise(family.signatures(marker_id), quarter_turns)
    assume(0 < code[kept].sum() < kept.sum())
    cells = np.where(kept, level + 10**log_gain * code, rng.normal(0, 1e3, CELLS))
    reading = family.decode(cells, erased)
    assert isinstance(reading, Reading)
    assert (reading.marker_id, reading.quarter_turns, reading.hamming) == (marker_id, quarter_turns, 0)
    assert reading.correlation == pytest.approx(1.0)


@pytest.mark.parametrize("seed", [0])
def test_soft_decoding_is_nearly_as_good_as_trying_all_readings(seed):
    """Where noise breaks half of the readings at hard decisions, all but a few in a thousand are found."""
    family = FAMILIES["astratag48h16"]
    all_readings = np.concatenate([turn_clockwise(family.signatures(np.arange(len(family))), k) for k in range(4)])
    rng = np.random.default_rng(seed)
    everything = np.ones((1, CELLS), bool)
    soft = exhaustive = hard = 0
    for _ in range(300):
        row = int(rng.integers(len(all_readings)))
        truth = (row % len(family), row // len(family))
        cells = all_readings[row] + rng.normal(0, 0.5, CELLS)
        reading = family.decode(cells, threshold=0.0)
        soft += isinstance(reading, Reading) and (reading.marker_id, reading.quarter_turns) == truth
        exhaustive += int(correlations(cells, everything, all_readings).argmax()) == row
        corrected = family.correct((cells > 0.5).astype(np.uint8))
        hard += isinstance(corrected, Codeword) and (corrected.marker_id, corrected.quarter_turns) == truth
    assert soft >= exhaustive - 2
    assert hard < 0.5 * soft


@given(st.sampled_from(["astratag20", "astratag48h16", "astratag48h12:0-99"]), seeds, st.floats(-1, 2))
def test_finds_a_marker_with_one_side_covered_and_nobody_saying_so(name, seed, brightness):
    """Left to itself the cover spoils the correlation; with leave to do without three regions, it does not."""
    dictionary = load_dictionary(name)
    rng = np.random.default_rng(seed)
    row = int(rng.integers(len(dictionary)))
    side = REGION_CELLS[[0, 3, 4]]
    cells = dictionary.signatures[row] + rng.normal(0, 0.1, CELLS)
    cells[side] = brightness
    covered = dictionary.decode(cells, most_missing=3)
    assert isinstance(covered, Reading)
    assert (covered.marker_id, covered.quarter_turns) == (dictionary.ids[row], 0)
    assert set(covered.missing) <= {0, 3, 4}
    told = dictionary.decode(cells, np.isin(np.arange(REGIONS), [0, 3, 4]))
    assert isinstance(told, Reading)
    assert told.marker_id == dictionary.ids[row]


@every_family
def test_a_whole_family_does_without_regions_too(family):
    cells = family.signatures(1001) * 80.0 + 20
    cells[REGION_CELLS[[1, 5]]] = 250
    reading = family.decode(cells, most_missing=2)
    assert reading == Reading(1001, 0, pytest.approx(1.0), 0, missing=(1, 5), cells=36)


@pytest.mark.parametrize("most_missing", [-1, 8])
def test_refuses_to_do_without_all_regions(most_missing):
    with pytest.raises(ValueError, match=f"most_missing must be a .*number.*, got {most_missing}"):
        load_dictionary().decode(np.arange(48.0), most_missing=most_missing)


@pytest.mark.parametrize("most_missing", [0, 3])
@every_family
def test_chance_and_flat_patches_are_refused(family, most_missing):
    rng = np.random.default_rng(2)
    for cells in rng.normal(size=(300, CELLS)):
        assert isinstance(family.decode(cells, most_missing=most_missing), Rejected)
    assert family.decode(np.full(CELLS, 117.3)) == Rejected("the cells show no contrast")


@pytest.mark.parametrize(
    ("cells", "erased", "message"),
    [
        (np.zeros(36), None, r"48 finite brightnesses, got shape \(36,\)"),
        (np.zeros((1, CELLS)), None, r"got shape \(1, 48\): one code at a time"),
        (np.full(CELLS, np.nan), None, "finite"),
        (np.zeros(CELLS), np.zeros(CELLS, bool), r"8 booleans, one a region, got bool \(48,\)"),
        (np.zeros(CELLS), [0, 3], "8 booleans"),
    ],
)
@pytest.mark.parametrize("decoder", [FAMILIES["astratag48h12"], load_dictionary()], ids=["family", "active set"])
def test_refuses_other_arrays(decoder, cells, erased, message):
    with pytest.raises(ValueError, match=message):
        decoder.decode(cells, erased)


# --- what chance does


@pytest.mark.parametrize("cells", [6, 24, 48])
def test_chance_of_correlation_is_students_t(cells):
    for r in (-0.5, 0.0, 0.3, 0.7, 0.9):
        t = r * np.sqrt((cells - 2) / (1 - r**2))
        assert chance_of_correlation(r, cells) == pytest.approx(stats.t.sf(t, cells - 2), rel=1e-9)


def correlations_of_chance(rng, candidates, mix=None):
    """Return all correlations of random candidates with the published readings, (C, 80)."""
    codes = load_dictionary().oriented.reshape(-1, CELLS).astype(float)
    codes -= codes.mean(axis=1, keepdims=True)
    cells = rng.normal(size=(candidates, CELLS))
    cells = cells if mix is None else cells @ mix
    cells -= cells.mean(axis=1, keepdims=True)
    return (cells / np.linalg.norm(cells, axis=1)[:, None]) @ (codes / np.linalg.norm(codes, axis=1)[:, None]).T


@pytest.mark.parametrize("rate", [1e-1, 1e-2, 1e-3])
def test_random_cells_pass_the_threshold_at_the_rate_asked_for(rate):
    """Monte Carlo: never more often, and the union bound gives away little where it matters."""
    best = correlations_of_chance(np.random.default_rng(3), 100_000).max(axis=1)
    share = (best > acceptance_threshold(templates=80, false_accept_rate=rate)).mean()
    noise = 4 * np.sqrt(rate / len(best))
    assert 0.8 * rate - noise < share < rate + noise


def test_more_comparisons_need_more_correlation():
    assert acceptance_threshold(80) == pytest.approx(0.703, abs=1e-3)
    assert acceptance_threshold(80, warps=8) == acceptance_threshold(640) > acceptance_threshold(80)
    assert acceptance_threshold(80, false_accept_rate=1e-9) > acceptance_threshold(80)
    assert acceptance_threshold(80, cells=30) > acceptance_threshold(80)
    assert acceptance_threshold(80, cells=2) == 1.0
    assert acceptance_threshold(1, false_accept_rate=0.5) == pytest.approx(0.0)


def test_textures_that_resemble_the_codes_are_worth_fewer_cells():
    """Where chance favours the directions in which the codes lie, the threshold must rise, and then holds."""
    independent = correlations_of_chance(np.random.default_rng(4), 20_000).max(axis=1)
    assert effective_cells(independent, templates=80) == pytest.approx(CELLS, rel=0.1)
    codes = load_dictionary().oriented.reshape(-1, CELLS) - 0.5
    mix = codes[:12].T @ codes[:12] + np.eye(CELLS)
    alike = correlations_of_chance(np.random.default_rng(4), 50_000, mix).max(axis=1)
    cells = effective_cells(alike, templates=80)
    assert cells < 40
    fresh = correlations_of_chance(np.random.default_rng(5), 50_000, mix).max(axis=1)
    naive, careful = (acceptance_threshold(80, false_accept_rate=2e-3, cells=c) for c in (CELLS, cells))
    assert (fresh > naive).mean() > 2 * 2e-3
    assert (fresh > careful).mean() == pytest.approx(2e-3, abs=4 * np.sqrt(2 * 2e-3 / len(fresh)))
    with pytest.raises(ValueError, match=r"at least 1000 correlations, one a candidate, got \(999,\)"):
        effective_cells(alike[:999], templates=80)


def test_smooth_textures_do_not_read_as_markers(rate=1e-2):
    """Cells that share their noise in pairs pass no more often than independent ones: the codes are rough."""
    pairs = np.kron(np.eye(CELLS // 2), np.ones((2, 2)))
    best = correlations_of_chance(np.random.default_rng(4), 50_000, pairs).max(axis=1)
    assert (best > acceptance_threshold(80, false_accept_rate=rate)).mean() < rate


def test_hard_thresholds_of_the_paper():
    """Twenty markers in four turns: ten wrong cells of 48 let one chance pattern in four hundred pass."""
    for tau, rate in ((3, 5.3e-9), (5, 5.5e-7), (10, 2.5e-3)):
        assert hamming_false_accept_rate(tau, templates=80) == pytest.approx(rate, rel=0.05)
    readings = load_dictionary().oriented.reshape(-1, CELLS)
    coins = np.random.default_rng(6).integers(0, 2, (60_000, CELLS), dtype=np.uint8)
    nearest = np.bitwise_count(pack(coins)[:, None] ^ pack(readings)).min(axis=1)
    rate = hamming_false_accept_rate(10, templates=80)
    assert (nearest <= 10).mean() == pytest.approx(rate, abs=4 * np.sqrt(rate / len(coins)))


def test_how_many_wrong_cells_may_be_forgiven():
    assert hamming_threshold(templates=80) == 5
    assert hamming_threshold(templates=4_000) == 3
    assert hamming_threshold(templates=16_000_000) == 0
    assert hamming_threshold(templates=16_000_000, warps=100) is None


@pytest.mark.parametrize(
    "call",
    [
        lambda: acceptance_threshold(0),
        lambda: acceptance_threshold(80, warps=0),
        lambda: acceptance_threshold(80, false_accept_rate=0.0),
        lambda: acceptance_threshold(80, false_accept_rate=float("nan")),
        lambda: hamming_false_accept_rate(3, templates=0),
    ],
)
def test_refuses_rates_and_counts_that_are_none(call):
    with pytest.raises(ValueError, match=r"1 or more|in \(0, 1\)|finite"):
        call()


# --- active sets


@pytest.mark.parametrize(
    ("name", "count", "distance"),
    [
        ("astratag48h16", 20, 18),
        ("astratag48h16", 1008, 16),
        ("astratag48h12", 20, 20),
        ("astratag48h12", 100, 16),
        ("astratag48h12", 1000, 14),
        ("astratag48h9", 20, 18),
    ],
)
def test_selected_identities_are_further_apart_than_the_family(name, count, distance):
    ids = select_identities(FAMILIES[name], count, seed=0)
    assert len(set(ids)) == count
    assert load_dictionary(name, ids).minimum_distance >= distance


def test_a_selection_grows_without_changing():
    family = FAMILIES["astratag48h12"]
    assert select_identities(family, 30, seed=1)[:10] == select_identities(family, 10, seed=1)
    assert select_identities(family, 10, seed=1) != select_identities(family, 10, seed=2)


@pytest.mark.parametrize("count", [0, 1009])
def test_refuses_to_select_none_or_more_than_there_are(count):
    with pytest.raises(ValueError, match=f"count must be in 1-1008, the identities of astratag48h16, got {count}"):
        select_identities(FAMILIES["astratag48h16"], count)
