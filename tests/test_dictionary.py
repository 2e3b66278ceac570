"""The published dictionary and its distances, and what a dictionary must refuse."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astratag.codes import FAMILIES, Reading, Rejected
from astratag.dictionary import ORIENTATIONS, Dictionary, load_dictionary, published_signature, write_dictionary
from astratag.geometry import CELLS, turn_clockwise

DICTIONARY = load_dictionary()
READINGS = DICTIONARY.oriented.reshape(-1, CELLS)
CORRECTABLE = 5


def as_reference_json(dictionary):
    return {
        str(i): {
            name: {"signature": "".join(map(str, dictionary.oriented[row, k]))} for k, name in enumerate(ORIENTATIONS)
        }
        for row, i in enumerate(dictionary.ids)
    }


def written(tmp_path, entries):
    path = tmp_path / "family.json"
    path.write_text(entries if isinstance(entries, str) else json.dumps(entries))
    return path


def test_every_published_signature_in_every_orientation(shared):
    """From twenty 24-bit messages and the turn permutation, all eighty signatures of the reference's file."""
    published = json.loads((shared / "reference/new_dictionary.json").read_text())
    ours = as_reference_json(DICTIONARY)
    assert {i: {k: r["signature"] for k, r in entry.items()} for i, entry in published.items()} == {
        i: {k: r["signature"] for k, r in entry.items()} for i, entry in ours.items()
    }


def test_the_reference_file_reads_as_the_built_in_family(shared):
    read = load_dictionary(shared / "reference/new_dictionary.json")
    assert read.ids == DICTIONARY.ids
    assert read.family == "new_dictionary"
    np.testing.assert_array_equal(read.signatures, DICTIONARY.signatures)


def test_twenty_markers_twelve_bits_apart_over_all_rotations():
    assert len(DICTIONARY) == 20
    assert DICTIONARY.minimum_distance == 12 > 2 * CORRECTABLE
    own = (DICTIONARY.oriented[:, :, None] != DICTIONARY.oriented[:, None, :]).sum(axis=-1)
    assert own[:, ~np.eye(4, dtype=bool)].min() == 16


@given(
    st.integers(0, 19),
    st.integers(0, 3),
    st.sets(st.integers(0, CELLS - 1), min_size=CORRECTABLE, max_size=CORRECTABLE),
)
def test_five_bit_errors_are_always_correctable(row, quarter_turns, wrong):
    """The nearest reading is the right one, alone."""
    received = turn_clockwise(DICTIONARY.signatures[row], quarter_turns)
    received[list(wrong)] ^= 1
    distances = (received != READINGS).sum(axis=1)
    assert distances.argmin() == 4 * row + quarter_turns
    assert (distances == distances.min()).sum() == 1


def test_a_dictionary_cannot_be_changed_by_accident():
    turned = turn_clockwise(DICTIONARY.signatures[0], 0)
    turned ^= 1
    np.testing.assert_array_equal(DICTIONARY.signatures[0], published_signature(0x3AD948))
    with pytest.raises(ValueError, match="read-only"):
        DICTIONARY.signature(0)[0] = 1


def test_signature_by_id():
    np.testing.assert_array_equal(DICTIONARY.signature(19), published_signature(0x96D66E))
    with pytest.raises(ValueError, match=r"marker 20 is not in dictionary 'astratag20' \(ids 0-19\)"):
        DICTIONARY.signature(20)


def test_a_written_dictionary_reads_back_with_its_ids(tmp_path):
    subset = Dictionary("family", (4, 7, 11), DICTIONARY.signatures[[4, 7, 11]])
    read = load_dictionary(written(tmp_path, as_reference_json(subset)))
    assert read.ids == (4, 7, 11)
    np.testing.assert_array_equal(read.signature(7), DICTIONARY.signature(7))


def test_the_upright_signature_is_enough(tmp_path):
    upright = {i: {"0": entry["0"]} for i, entry in as_reference_json(DICTIONARY).items()}
    np.testing.assert_array_equal(load_dictionary(written(tmp_path, upright)).oriented, DICTIONARY.oriented)


def symmetric_signature():
    bits = np.zeros(CELLS, np.uint8)
    bits[0] = 1
    return np.bitwise_or.reduce([turn_clockwise(bits, k) for k in range(4)])


@pytest.mark.parametrize(
    ("signatures", "why"),
    [
        (np.stack([DICTIONARY.signatures[0]] * 2), "two ids alike"),
        (np.stack([DICTIONARY.signatures[0], turn_clockwise(DICTIONARY.signatures[0])]), "one is the other turned"),
        (symmetric_signature()[None], "looks the same turned"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refuses_colliding_signatures(signatures, why):
    with pytest.raises(ValueError, match="colliding signatures"):
        Dictionary("bad", tuple(range(len(signatures))), signatures)


@pytest.mark.parametrize(
    ("ids", "signatures", "message"),
    [
        ((), np.zeros((0, CELLS), np.uint8), "holds no markers"),
        ((3, 3), DICTIONARY.signatures[:2], "lists an id twice"),
        ((3,), DICTIONARY.signatures[:2], r"signatures must be \(1, 48\), got \(2, 48\)"),
        ((3,), DICTIONARY.signatures[:1, :36], r"must be \(1, 48\), got \(1, 36\)"),
        ((3,), DICTIONARY.signatures[:1] * 2, "neither 0 nor 1"),
    ],
)
def test_refuses_a_malformed_family(ids, signatures, message):
    with pytest.raises(ValueError, match=message):
        Dictionary("bad", ids, signatures)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ("{", "cannot read dictionary"),
        ("[]", "holds no markers|is not"),
        ("{}", "holds no markers"),
        ("3", "is not"),
        ({"0": {"90": {"signature": "0" * 48}}}, "is not"),
        ({"zero": {"0": {"signature": "0" * 48}}}, "is not"),
        ({"0": {"0": {"signature": "01" * 18}}}, r"got \(1, 36\)"),
        ({"0": {"0": {"signature": "2" * 48}}}, "neither 0 nor 1"),
        ({"0": {"0": {"signature": "0" * 48}}}, "colliding"),
    ],
)
def test_refuses_a_malformed_file_in_one_line_that_names_it(tmp_path, entries, message):
    path = written(tmp_path, entries)
    with pytest.raises(ValueError, match=message) as error:
        load_dictionary(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_refuses_a_turned_signature_that_is_not_the_upright_one_turned(tmp_path):
    entries = as_reference_json(DICTIONARY)
    entries["5"]["90"], entries["5"]["270"] = entries["5"]["270"], entries["5"]["90"]
    with pytest.raises(ValueError, match="the 90 degree signature of id 5 is not"):
        load_dictionary(written(tmp_path, entries))


@pytest.mark.parametrize("name", ["astratag21", "", "no/such/file.json"])
def test_refuses_an_unknown_name(name):
    with pytest.raises(ValueError, match="unknown dictionary"):
        load_dictionary(name)


def test_refuses_a_binary_file(tmp_path):
    path = tmp_path / "family.json"
    path.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ValueError, match="cannot read dictionary"):
        load_dictionary(path)


def test_writing_the_published_twenty_gives_the_reference_file(shared, tmp_path):
    """Signatures, world points, their order and the layout of the file: every byte."""
    written_to = write_dictionary(DICTIONARY, tmp_path / "twenty.json")
    assert written_to.read_text() == (shared / "reference/new_dictionary.json").read_text()


@pytest.mark.parametrize("name", ["astratag20", "astratag48h12:7,900-904", "astratag48h9:4193279"])
def test_what_is_written_reads_back(tmp_path, name):
    dictionary = load_dictionary(name)
    read = load_dictionary(write_dictionary(dictionary, tmp_path / "some.json", side_m=0.1))
    assert read.ids == dictionary.ids
    np.testing.assert_array_equal(read.oriented, dictionary.oriented)


def test_world_points_are_the_corners_of_the_print_in_millimetres(tmp_path):
    entries = json.loads(write_dictionary(DICTIONARY, tmp_path / "some.json", side_m=0.1).read_text())
    assert entries["3"]["0"]["world_points"] == [[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0]]
    # turned clockwise, the print's bottom-left corner is the image's top-left one
    assert entries["3"]["90"]["world_points"][0] == [0, 100, 0]


@pytest.mark.parametrize("side_m", [0.0, -1.0, float("nan")])
def test_refuses_to_write_a_side_that_is_no_length(tmp_path, side_m):
    with pytest.raises(ValueError, match="side_m must be a positive length"):
        write_dictionary(DICTIONARY, tmp_path / "some.json", side_m)


def test_a_family_by_name_with_the_ids_in_use():
    by_text = load_dictionary("astratag48h12:0-2, 64511,40")
    assert by_text.family == "astratag48h12"
    assert by_text.ids == (0, 1, 2, 64511, 40)
    by_list = load_dictionary("astratag48h12", ids=np.array(by_text.ids))
    np.testing.assert_array_equal(by_text.signatures, by_list.signatures)
    np.testing.assert_array_equal(by_text.signature(40), FAMILIES["astratag48h12"].signatures(40))
    assert load_dictionary("astratag20:3,5").ids == (3, 5)


def test_ids_of_a_file(tmp_path):
    path = write_dictionary(DICTIONARY, tmp_path / "twenty.json")
    np.testing.assert_array_equal(load_dictionary(f"{path}:7").signatures, DICTIONARY.signatures[[7]])
    np.testing.assert_array_equal(load_dictionary(path, ids=[7]).signatures, DICTIONARY.signatures[[7]])


def test_a_small_family_whole_has_its_distance():
    whole = load_dictionary("astratag48h16")
    assert len(whole) == 1008
    assert whole.minimum_distance == 16


@pytest.mark.parametrize(
    ("name", "ids", "message"),
    [
        ("astratag48h9", None, "4193280 identities, too many"),
        ("astratag48h16:1008", None, "astratag48h16 has ids 0-1007, got 1008"),
        ("astratag48h16", [-1, 3], "astratag48h16 has ids 0-1007, got -1"),
        ("astratag20:20", None, "marker 20 is not in dictionary"),
        ("astratag20:4,4", None, "lists an id twice"),
        ("astratag20:", None, "listed like 0-99,205, got ''"),
        ("astratag20:9-3", None, "listed like 0-99,205, got '9-3'"),
        ("astratag48h9:0-999999999", None, "listed like"),
        ("astratag20:-3", None, "listed like"),
        ("astratag20:3", [3], "given twice"),
        ("astratag20", [], "holds no markers"),
        ("astratag20", [1.5], "ids must be a list of integers"),
        ("astratag20", 3, "ids must be a list of integers"),
        ("astratag7:3", None, "unknown dictionary 'astratag7'"),
    ],
)
def test_refuses_ids_that_make_no_active_set(name, ids, message):
    with pytest.raises(ValueError, match=message) as error:
        load_dictionary(name, ids)
    assert "\n" not in str(error.value)


@given(st.integers(0, 19), st.integers(0, 3), st.integers(0, 2**32 - 1), st.sets(st.integers(0, 7), max_size=3))
def test_decodes_dim_noisy_and_partly_covered_cells(row, quarter_turns, seed, covered):
    erased = np.isin(np.arange(8), list(covered))
    cells = 40 + 15 * turn_clockwise(DICTIONARY.signatures[row], quarter_turns)
    reading = DICTIONARY.decode(cells + np.random.default_rng(seed).normal(0, 2, CELLS), erased)
    assert isinstance(reading, Reading)
    assert (reading.marker_id, reading.quarter_turns, reading.hamming) == (row, quarter_turns, 0)
    assert reading.correlation > 0.9


def test_decoding_refuses_chance_and_says_why():
    cells = np.random.default_rng(5).normal(size=CELLS)
    refusal = DICTIONARY.decode(cells)
    assert isinstance(refusal, Rejected)
    assert "below 0.703" in refusal.reason
    assert isinstance(DICTIONARY.decode(cells, threshold=0.0), Reading)


def test_decoding_refuses_what_is_left_when_it_fits_two_markers():
    """Two codes that differ in the top-left region only, and that region is covered."""
    other = DICTIONARY.signatures[0].copy()
    other[:3] ^= 1
    alike = Dictionary("alike", (0, 1), np.stack([DICTIONARY.signatures[0], other]))
    erased = np.arange(8) == 0
    refusal = alike.decode(other.astype(float), erased)
    assert refusal == Rejected("two readings fit alike in the regions in view")
    reading = alike.decode(other.astype(float))
    assert isinstance(reading, Reading)
    assert reading.marker_id == 1
