"""A pickle gives plain data or a polite refusal, and never runs anything."""

import builtins
import json
import os
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from openvocab_occ.errors import DataError, NotFoundError, UnsafeFileError
from openvocab_occ.io.plain_pickle import read_plain_pickle

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner, inner),
    max_leaves=10,
)
numbers = hnp.arrays(
    st.sampled_from(["f4", "f8", "i8", ">i4", "u1", "?", "U3"]), hnp.array_shapes(min_dims=0, min_side=0)
)


class Call:
    """Pickles as a call of any function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@given(value=plain, protocol=st.integers(0, pickle.HIGHEST_PROTOCOL))
def test_plain_data_survives(tmp_path_factory, value, protocol):
    path = tmp_path_factory.getbasetemp() / "plain.pkl"
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    assert read_plain_pickle(path) == value


@given(array=numbers, transposed=st.booleans(), protocol=st.integers(0, pickle.HIGHEST_PROTOCOL))
def test_arrays_survive(tmp_path_factory, array, transposed, protocol):
    array = array.T if transposed else array
    path = tmp_path_factory.getbasetemp() / "array.pkl"
    path.write_bytes(pickle.dumps({"a": array}, protocol=protocol))
    found = read_plain_pickle(path)["a"]
    assert found.dtype.newbyteorder("=") == array.dtype.newbyteorder("=")
    assert found.shape == array.shape
    assert found.astype(array.dtype).tobytes() == array.tobytes()


@pytest.mark.data
def test_real_info_file_reads_as_its_json(keyframe):
    (path,) = keyframe.glob("*.pkl")

    def normal(value):
        return json.loads(json.dumps(value, default=lambda number: number.item()))

    told = json.loads((keyframe / "info.json").read_text())
    assert repr(normal(read_plain_pickle(path))) == repr(normal(told))  # by text, because NaN != NaN


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize(
    ("bad", "name"),
    [
        (Call(os.system, "touch {marker}"), "system"),
        (Call(builtins.eval, "open('{marker}', 'w')"), "eval"),
        (Call(getattr, "x", "__class__"), "getattr"),
        (np.random.default_rng(0), "numpy.random"),
        (np.linalg.norm, "norm"),
    ],
)
def test_code_is_refused_and_not_run(tmp_path, bad, name, protocol):
    marker = tmp_path / "ran"
    if isinstance(bad, Call):
        function, arguments = bad.call
        bad = Call(function, *(a.format(marker=marker) for a in arguments))
    path = tmp_path / "bad.pkl"
    path.write_bytes(pickle.dumps({"data_list": [bad]}, protocol=protocol))
    with pytest.raises(UnsafeFileError, match=name):
        read_plain_pickle(path)
    assert not marker.exists()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize(
    "array",
    [
        np.array([1, "a", None], dtype=object),
        np.zeros(2, dtype=[("a", "f4"), ("b", "O")]),
        np.zeros(2, dtype=[("a", "f4")]),
        np.array(["2020-01-01"], dtype="M8[D]"),
    ],
)
def test_arrays_of_objects_and_structures_are_refused(tmp_path, array, protocol):
    path = tmp_path / "objects.pkl"
    path.write_bytes(pickle.dumps(array, protocol=protocol))
    with pytest.raises(UnsafeFileError, match="array of objects"):
        read_plain_pickle(path)


@pytest.mark.parametrize(
    "program",
    [
        b"c_codecs\nencode\n(N}S'__defaults__'\n(S'latin1'\ntstb.",  # BUILD on a function
        b"cnumpy\ndtype\n(N}S'x'\nI1\nstb.",  # BUILD on a class
        b"cnumpy\nndarray\n(I3\ntR.",  # an array without its bytes
        b"c_codecs\nencode\n(S'x'\nS'rot13'\ntR.",
        b"cnumpy.core.multiarray\nscalar\n(I1\nI2\ntR.",
    ],
)
def test_admitted_names_cannot_be_abused(tmp_path, program):
    path = tmp_path / "abuse.pkl"
    path.write_bytes(program)
    with pytest.raises(UnsafeFileError, match=r"abuse\.pkl: .*save it as JSON"):
        read_plain_pickle(path)


@pytest.mark.parametrize("content", [b"", b"hello", pickle.dumps([1, 2, 3])[:-4], b"\x80\x09."])
def test_damaged_files_are_data_errors(tmp_path, content):
    path = tmp_path / "cut.pkl"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"cut\.pkl cannot be read"):
        read_plain_pickle(path)


def test_missing_file(tmp_path):
    with pytest.raises(NotFoundError, match="pickle file not found"):
        read_plain_pickle(tmp_path / "no.pkl")
