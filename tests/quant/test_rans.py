from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from layers import only_in_acceptance
from property_tests import examples
from scipy.special import gammaln
from token_streams import decode_tokens_by_spec, laplace_tokens

from hyrfpack.parallel import has_numba
from hyrfpack.quant import rans
from hyrfpack.quant.errors import DamagedDataError
from hyrfpack.quant.rans import MAX_LANES, decode_tokens, encode_tokens
from hyrfpack.quant.rans_lanes import LaneLayout
from hyrfpack.quant.rans_models import LEVEL_WEIGHTS, MAX_LEVEL, adaptive_frequencies, normalise

CODER_IMPLEMENTATIONS = ["numpy", pytest.param("cpu", marks=pytest.mark.skipif(not has_numba(), reason="no numba"))]
STATIC_MODELS, ADAPTIVE_MODELS, SINGLE_TOKEN_MODELS = "static", "adaptive", "one token a context"

_rng = np.random.default_rng(0)
_uneven = (_rng.random(40_000) ** 3 * 30).astype(np.uint8)


def correlated_tokens(count: int) -> np.ndarray:
    """Return tokens whose scale changes slowly, so that large tokens follow large ones."""
    rng, scale = np.random.default_rng(count), np.repeat(np.geomspace(0.2, 8, 20), -(-count // 20))[:count]
    return np.minimum(np.rint(np.abs(rng.laplace(scale=scale))), 60).astype(np.uint8)


HARD_CASES = {
    "one token": (np.array([125], np.uint8), None),
    "two tokens": (np.array([0, 125], np.uint8), None),
    "constant": (np.full(5000, 7, np.uint8), None),
    "one token a context": (np.arange(1000).astype(np.uint8) % 5 + 3, np.arange(1000).astype(np.uint8) % 5),
    "all tokens once": (_rng.permutation(126).astype(np.uint8), None),
    "uniform": (_rng.integers(0, 126, 30_000).astype(np.uint8), None),
    "almost constant": ((_rng.random(200_000) < 1e-4).astype(np.uint8), None),
    "one outlier": (np.append(np.zeros(3000), 125).astype(np.uint8), None),
    "laplace": (laplace_tokens(20_000, [3.0])),
    "contexts": (laplace_tokens(30_000, [0.3, 1, 3, 10, 40])),
    "many contexts, few tokens": (laplace_tokens(3000, np.geomspace(0.3, 40, 30))),
    "more contexts than tokens": (laplace_tokens(200, np.geomspace(0.3, 40, 256))),
    "unused contexts": (_uneven % 3, np.where(_uneven % 2, 250, 7).astype(np.uint8)),
    "many tokens, static": (laplace_tokens(400_000, [0.3, 40])),
    "classes": (correlated_tokens(50_000), None),
    "classes and contexts": (correlated_tokens(50_000), (np.arange(50_000) // 25_000).astype(np.uint8)),
    "last lane of one token": (laplace_tokens(8 * 4000 + 1, [4.0])),
}

# Each of these has the same kind of model as another case.
SIMILAR_CASES = {"almost constant", "classes", "contexts", "uniform", "unused contexts"}


def model_kind(data: bytes) -> str:
    return SINGLE_TOKEN_MODELS if data[1] == 0 else STATIC_MODELS if data[0] & 128 else ADAPTIVE_MODELS


def adaptive_bits(tokens: np.ndarray, contexts: np.ndarray) -> float:
    """Return the bits of the ideal adaptive code: a model for each context, whose counts all start at 1/2."""
    size = int(tokens.max()) + 1
    counts = np.bincount(contexts.astype(np.int64) * size + tokens, minlength=size * 256).reshape(256, size)
    logs = (gammaln(counts + 0.5) - gammaln(0.5)).sum(1) - gammaln(counts.sum(1) + size / 2) + gammaln(size / 2)
    return float(-logs.sum() / np.log(2))


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@pytest.mark.parametrize("name", only_in_acceptance(HARD_CASES, SIMILAR_CASES))
def test_tokens_round_trip(name: str, implementation: str) -> None:
    tokens, contexts = HARD_CASES[name]

    data = encode_tokens(tokens, contexts, implementation)
    decoded, size, alphabet = decode_tokens(data + b"more", len(tokens), contexts, implementation)

    np.testing.assert_array_equal(decoded, tokens)
    assert decoded.dtype == np.uint8
    assert (size, alphabet) == (len(data), tokens.max() + 1)


@pytest.mark.skipif(not has_numba(), reason="no numba")
@pytest.mark.parametrize("name", only_in_acceptance(HARD_CASES, SIMILAR_CASES))
def test_numpy_and_numba_encode_tokens_to_the_same_bytes(name: str) -> None:
    assert encode_tokens(*HARD_CASES[name], "numpy") == encode_tokens(*HARD_CASES[name], "cpu")


@pytest.mark.parametrize(
    "name",
    only_in_acceptance([name for name, (tokens, _) in HARD_CASES.items() if len(tokens) <= 50_000], SIMILAR_CASES),
)
def test_a_decoder_written_from_the_specification_decodes_the_same_tokens(name: str) -> None:
    tokens, contexts = HARD_CASES[name]

    data = encode_tokens(tokens, contexts)

    listed = [0] * len(tokens) if contexts is None else contexts.tolist()
    assert decode_tokens_by_spec(data, listed) == (tokens.tolist(), len(data))


def test_cases_cover_all_kinds_of_models() -> None:
    streams = {name: encode_tokens(*case) for name, case in HARD_CASES.items()}

    assert {model_kind(data) for data in streams.values()} == {STATIC_MODELS, ADAPTIVE_MODELS, SINGLE_TOKEN_MODELS}
    assert all(streams[name][0] >> 4 & 7 for name in ("classes", "classes and contexts"))
    assert model_kind(streams["many tokens, static"]) == STATIC_MODELS


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@pytest.mark.parametrize("lanes_log2", range(14))
def test_any_number_of_lanes_decodes(lanes_log2: int, implementation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = correlated_tokens(777)
    contexts = (np.arange(777) % 3).astype(np.uint8)
    monkeypatch.setattr(rans, "_choose_lanes_log2", lambda count, bits: lanes_log2)

    data = encode_tokens(tokens, contexts, implementation)

    assert data[0] & 15 == lanes_log2
    assert decode_tokens_by_spec(data, contexts.tolist()) == (tokens.tolist(), len(data))
    np.testing.assert_array_equal(decode_tokens(data, 777, contexts, implementation).tokens, tokens)


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@given(data=st.data())
@examples(70)
def test_any_tokens_round_trip(implementation: str, data: st.DataObject) -> None:
    top, contexts_below = data.draw(st.sampled_from([0, 1, 3, 20, 125])), data.draw(st.integers(1, 256))
    pairs = data.draw(st.lists(st.tuples(st.integers(0, top), st.integers(0, contexts_below - 1)), max_size=400))
    tokens = np.array([token for token, _ in pairs], np.uint8)
    contexts = np.array([context for _, context in pairs], np.uint8) if contexts_below > 1 else None

    coded = encode_tokens(tokens, contexts, implementation)

    decoded = decode_tokens(coded, len(tokens), contexts, implementation)
    np.testing.assert_array_equal(decoded.tokens, tokens)
    assert decoded.size == len(coded)


@pytest.mark.parametrize(
    ("count", "scales", "excess"),
    [
        (3000, [3.0], 0.01),
        (3000, [1, 3, 10], 0.01),
        (30_000, [0.3, 1, 3, 10, 40], 0.01),
        (1_000_000, [3.0], 0.003),
        (1_000_000, [0.3, 1, 3, 10, 40], 0.003),
    ],
)
def test_streams_are_at_most_slightly_longer_than_the_ideal_adaptive_code(
    count: int, scales: list, excess: float
) -> None:
    tokens, contexts = laplace_tokens(count, scales)

    data = encode_tokens(tokens, contexts)

    assert 8 * len(data) <= (1 + excess) * adaptive_bits(tokens, contexts)


def test_contexts_with_few_symbols_share_statistics() -> None:
    tokens, contexts = laplace_tokens(3000, np.geomspace(0.3, 40, 30))

    assert 8 * len(encode_tokens(tokens, contexts)) < adaptive_bits(tokens, contexts)


def test_small_streams_have_at_most_10_bytes_of_header() -> None:
    tokens = np.random.default_rng(0).integers(0, 4, 100).astype(np.uint8)

    assert encode_tokens(np.zeros(0, np.uint8)) == b""
    assert len(encode_tokens(np.full(10**6, 9, np.uint8))) == 3
    assert len(encode_tokens(tokens)) <= 25 + 10  # 2 bits for each token, and 10 bytes of header


def test_correlated_tokens_are_coded_with_classes_of_the_previous_token() -> None:
    tokens = np.cumsum(np.random.default_rng(0).random(20_000) < 0.05).astype(np.uint8) % 2

    data = encode_tokens(tokens)

    share = 0.05
    assert 8 * len(data) < 1.1 * 20_000 * -(share * np.log2(share) + (1 - share) * np.log2(1 - share))


@given(st.data())
@examples(50)
def test_normalised_frequencies_add_up_and_keep_every_nonzero_weight(data: st.DataObject) -> None:
    size = data.draw(st.integers(1, 127))
    weight = st.one_of(st.just(0), st.integers(1, 50), st.integers(0, 2**50))
    weights = np.array([data.draw(st.lists(weight, min_size=size, max_size=size))])
    weights[0, data.draw(st.integers(0, size - 1))] += 1

    frequencies = normalise(weights)

    assert frequencies.sum() == 4096
    assert ((frequencies > 0) == (weights > 0)).all()


@pytest.mark.parametrize("raised", range(127))
def test_normalise_gives_every_rare_token_a_frequency(raised: int) -> None:
    weights = np.array([[1] * raised + [2**40] * (127 - raised)])

    assert normalise(weights).min() >= 1
    assert normalise(weights).sum() == 4096


def test_adaptive_frequencies_start_equal_and_accept_counts_up_to_their_bound() -> None:
    assert set(adaptive_frequencies(np.zeros((3, 64), np.int64)).ravel()) == {64}
    full = adaptive_frequencies(np.array([[2**33, 0], [0, 2**33]]))
    assert full.tolist() == [[4095, 1], [1, 4095]]


def test_level_weights_have_four_levels_per_octave() -> None:
    assert len(LEVEL_WEIGHTS) == MAX_LEVEL + 1
    assert LEVEL_WEIGHTS[0] == 0
    assert (LEVEL_WEIGHTS[5:] == 2 * LEVEL_WEIGHTS[1:-4]).all()
    assert LEVEL_WEIGHTS[MAX_LEVEL] == 4 * 4096


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@pytest.mark.parametrize(
    "name",
    only_in_acceptance(
        ["one token", "contexts", "classes", "one token a context", "many contexts, few tokens"],
        ["classes", "many contexts, few tokens"],
    ),
)
def test_truncation_is_refused(name: str, implementation: str) -> None:
    tokens, contexts = HARD_CASES[name]
    data = encode_tokens(tokens, contexts)

    for length in np.unique(np.append(np.arange(min(len(data), 50)), np.linspace(0, len(data) - 1, 12).astype(int))):
        with pytest.raises(DamagedDataError):
            decode_tokens(data[:length], len(tokens), contexts, implementation)


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@pytest.mark.parametrize(
    "name",
    only_in_acceptance(
        ["contexts", "classes", "many contexts, few tokens", "many tokens, static", "constant"],
        ["classes", "many contexts, few tokens"],
    ),
)
@given(data=st.data())
@examples(8)
def test_damaged_stream_is_refused_or_decodes_to_the_requested_count(
    name: str, implementation: str, data: st.DataObject
) -> None:
    tokens, contexts = HARD_CASES[name]
    tokens, contexts = tokens[:20_000], contexts if contexts is None else contexts[:20_000]
    damaged = bytearray(STREAM_BY_CASE.setdefault(name, encode_tokens(tokens, contexts)))
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(damaged) - 1) | st.integers(0, min(40, len(damaged) - 1)))
        damaged[place] ^= data.draw(st.integers(1, 255))

    try:
        decoded, size, alphabet = decode_tokens(bytes(damaged), len(tokens), contexts, implementation)
    except DamagedDataError:
        return
    assert decoded.shape == tokens.shape
    assert decoded.max() < alphabet <= 126
    assert size <= len(damaged)


STREAM_BY_CASE: dict[str, bytes] = {}


@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
@given(data=st.binary(max_size=100), count=st.integers(0, 3000))
@examples(200)
def test_random_bytes_are_refused_or_decode_to_the_requested_count(
    data: bytes, count: int, implementation: str
) -> None:
    try:
        decoded = decode_tokens(data, count, None, implementation)
    except DamagedDataError:
        return
    assert len(decoded.tokens) == count


@pytest.mark.parametrize(
    ("data", "claim"),
    [
        (b"\0", "fewer than its header"),
        (b"\x0e\x02" + bytes(64), "impossible values"),  # 2^14 lanes
        (b"\0\x7f" + bytes(64), "impossible values"),  # an alphabet of 127
        (b"\x10\x05\0" + bytes(64), "do not rise"),  # a threshold of 0
        (b"\x20\x05\x03\x03" + bytes(64), "do not rise"),
        (b"\x10\x05\x05" + bytes(64), "do not rise"),  # a threshold that no token reaches
        (b"\x01\0\x05", "missing or damaged"),  # lanes where there are none
        (b"\0\0\x7e", "missing or damaged"),  # token 126
        (b"\0\0", "missing or damaged"),
        (b"\x03\x02" + bytes(31), "lanes need"),
        (b"\0\x02" + bytes(4), "truncated"),  # a state of 0 needs words
        (b"\0\x02" + b"\xff" * 4 + bytes(400), "does not fit"),
        (b"\x80\x02\x80\x02" + bytes(64), "impossible values"),  # static models that code the levels of static models
        (b"\x80\x02\0\0\0" + bytes(64), "no valid frequencies"),  # levels of 0
        (b"\x80\x02\0\0\1" + bytes(64), "no valid frequencies"),  # levels of -1
        (b"\x80\x02\0\0\x34" + bytes(64), "no valid frequencies"),  # levels of 26 and 52
    ],
)
@pytest.mark.parametrize("implementation", CODER_IMPLEMENTATIONS)
def test_forged_streams_are_refused(data: bytes, claim: str, implementation: str) -> None:
    with pytest.raises(DamagedDataError, match=claim):
        decode_tokens(data, 1000, None, implementation)


def test_more_models_than_the_limit_are_refused() -> None:
    contexts = np.arange(256).astype(np.uint8)

    with pytest.raises(DamagedDataError, match="impossible values"):
        decode_tokens(b"\x40\x05\1\2\3\4" + bytes(64), 256, contexts)  # 256 contexts, 5 classes


@pytest.mark.parametrize("lanes_log2", range(13))
def test_too_few_lanes_for_a_huge_count_are_refused_before_any_allocation(lanes_log2: int) -> None:
    with pytest.raises(DamagedDataError, match="too few lanes"):
        decode_tokens(bytes((lanes_log2, 2)) + bytes(5 * MAX_LANES), 2**60)


def test_missing_states_for_a_huge_count_are_refused_before_any_allocation() -> None:
    with pytest.raises(DamagedDataError, match="lanes need"):
        decode_tokens(b"\x0d\x02" + bytes(1000), 2**60)


@pytest.mark.parametrize(
    ("tokens", "contexts", "claim"),
    [
        (np.zeros(3, np.int64), None, "uint8"),
        (np.zeros((2, 2), np.uint8), None, "uint8"),
        (np.array([126], np.uint8), None, "below 126"),
        (np.zeros(3, np.uint8), np.zeros(2, np.uint8), "contexts"),
        (np.zeros(3, np.uint8), np.zeros(3, np.int32), "contexts"),
    ],
)
def test_encode_refuses_other_dtypes_shapes_and_tokens(
    tokens: np.ndarray, contexts: np.ndarray | None, claim: str
) -> None:
    with pytest.raises(ValueError, match=claim):
        encode_tokens(tokens, contexts)


def test_invalid_implementation_and_count_are_refused() -> None:
    with pytest.raises(ValueError, match="auto, numpy, cpu"):
        encode_tokens(np.zeros(3, np.uint8), implementation="gpu")
    with pytest.raises(ValueError, match="0 or more"):
        decode_tokens(b"", -1)


@given(count=st.integers(1, 5000), asked=st.integers(0, 13).map(lambda log2: 1 << log2))
def test_active_lanes_are_those_that_have_a_token(count: int, asked: int) -> None:
    lanes = LaneLayout(count, asked)

    for step in {0, lanes.last_lane_steps - 1, lanes.last_lane_steps % lanes.steps, lanes.steps - 1}:
        active = [lane for lane in range(asked) if lane * lanes.steps + step < min(count, (lane + 1) * lanes.steps)]
        assert list(range(lanes.active_lanes(step))) == active
    assert lanes.used_lanes <= asked
