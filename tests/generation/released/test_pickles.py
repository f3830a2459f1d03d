"""An untrusted pickle gives numbers, or an error; it never runs anything."""

import builtins
import io
import os
import pickle
import struct
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from qs3.errors import DataError
from qs3.generation.released.pickles import MAX_BYTES, load_npy_object
from tests.limits import time_of_at_most


def npy(value, protocol=3) -> bytes:
    """As numpy saves one object, in any protocol of pickle."""
    file = io.BytesIO()
    header = {"descr": "|O", "fortran_order": False, "shape": ()}
    np.lib.format.write_array_header_1_0(file, header)
    array = np.empty((), dtype=object)
    array[()] = value
    pickle.dump(array, file, protocol=protocol)
    return file.getvalue()


HEAD = npy({})[:128]


def refused(data, why="more than plain values"):
    with pytest.raises(DataError, match=rf"(?s)bad\.npy.*{why}"):
        load_npy_object(data, "bad.npy")


PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**80), 2**80)
    | st.floats(allow_nan=False)
    | st.text(max_size=8)
    | st.binary(min_size=1, max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4)
    ),
    max_leaves=20,
)
ARRAYS = hnp.arrays(
    st.sampled_from(["<f8", "<f4", ">i2", "u1", "<i8", "?"]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)


@settings(deadline=None)
@given(st.dictionaries(st.text(max_size=4), PLAIN, max_size=4), st.integers(3, 4))
def test_plain_values_come_back(value, protocol):
    assert load_npy_object(npy(value, protocol), "x") == value


@settings(deadline=None)
@given(ARRAYS, st.integers(3, 4), st.booleans())
def test_arrays_come_back_as_numpy_itself_reads_them(array, protocol, transposed):
    data = npy({"a": array.T if transposed else array}, protocol)
    ours = load_npy_object(data, "x")["a"]
    theirs = np.load(io.BytesIO(data), allow_pickle=True)[()]["a"]
    # numpy may turn the bytes of a value round on the way: the value is what counts
    assert ours.dtype.newbyteorder("=") == theirs.dtype.newbyteorder("=")
    assert ours.shape == theirs.shape
    np.testing.assert_array_equal(ours, theirs)


def test_both_names_of_numpys_module_are_known():
    data = npy({"a": np.arange(3.0)})
    assert b"numpy.core.multiarray" in data
    renamed = data.replace(b"numpy.core.multiarray", b"numpy._core.multiarray")
    np.testing.assert_array_equal(load_npy_object(renamed, "x")["a"], [0, 1, 2])


class Run:
    """Calls a function when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(5))
def test_functions_are_refused_and_not_run(tmp_path, protocol):
    victim = tmp_path / "gone"
    for function, argument, name in (
        (os.system, f"touch {victim}", r"posix\.system"),
        (builtins.eval, f"open({str(victim)!r}, 'w')", r"_*builtins?_*\.eval"),
        (os.mkdir, str(victim), r"posix\.mkdir"),
        (np.load, str(victim), r"numpy.*load"),
        (np.zeros, 10**12, r"numpy.*zeros"),
        (bytearray, 2**40, r"_*builtins?_*\.bytearray"),
        (pickle.loads, b"N.", r"_?pickle\.loads"),
    ):
        value = Run(function, argument)
        refused(npy({"a": [1, value]}, protocol), "" if protocol < 3 else name)
        refused(HEAD + pickle.dumps(value, protocol), "" if protocol < 2 else name)
    assert not victim.exists()
    os.mkdir(tmp_path / "works")  # what a victim would look like
    pickle.loads(pickle.dumps(Run(os.mkdir, str(victim)), protocol))
    assert victim.exists()


def dtype_of(state: bytes) -> bytes:
    return b"\x80\x03cnumpy\ndtype\nX\x02\x00\x00\x00f8\x89\x88\x87R" + state + b"b."


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"cbuiltins\n__import__\n.", r"builtins\.__import__"),
        (b"cnumpy\nload\n.", r"numpy\.load"),
        (b"cnumpy.core.multiarray\n_reconstruct.__globals__\n.", "__globals__"),
        (b"\x80\x04\x8c\x05numpy\x8c\x0cndarray.dump\x93.", r"ndarray\.dump"),
        (b"cnumpy\nndarray\n(J\xff\xff\xff\x7ftR.", "not callable"),  # would reserve 8 TB
        (b"cnumpy\ndtype\n(X\x0b\x00\x00\x00V2000000000\x89\x88tR.", "type 'V2000000000'"),
        (dtype_of(b"(K\x03X\x01\x00\x00\x00<K\x01NNt"), "an array with fields"),
        (b"cnumpy\ndtype\n}X\x01\x00\x00\x00aNsb.", "a state for what has none"),
        (b"cnumpy.core.multiarray\n_reconstruct\n}X\x01\x00\x00\x00aNsb.", "a state for"),
        (b"cnumpy\nndarray\n.", "contradict"),
        (b"P1\n.", ""),  # persistent id
        (b"\x82\x01.", ""),  # registered extension
        (b"(ios\nsystem\n.", ""),  # another way of calling
        (b"cnumpy\ndtype\n)\x81.", ""),
        (b"\x96" + struct.pack("<Q", 2**40) + b"abc.", ""),  # a bytearray of 1 TB
        (b"Nr\xff\xff\xff\x7f.", "contradict"),  # memo entry: C's pickle reserves 32 GB
        (b"r\xff\xff\xff\x7f.", ""),
        (b"\x8b\xff\xff\xff\x7f.", ""),
        (b"B" + struct.pack("<I", 2**31 - 1) + b"abc.", ""),
        (b"X" + struct.pack("<I", 2**31 - 1) + b"abc.", ""),
        (b"\x95" + struct.pack("<Q", 2**62) + b"N.", ""),
        (b"N", ""),
        (b".", ""),
        (b"", ""),
    ],
)
def test_crafted_pickles_are_refused(data, why):
    refused(HEAD + data, why)
    # and leave nothing behind
    back = load_npy_object(npy({"a": np.arange(3)}), "x")["a"]
    np.testing.assert_array_equal(back, [0, 1, 2])


def test_arrays_that_promise_more_than_they_hold_are_refused():
    data = npy({"a": np.arange(6.0).reshape(2, 3)})
    for big in (b"J\xff\xff\xff\x7f", b"J\x03\x00\x00\x00", b"J\xff\xff\xff\xff", b"G" + bytes(8)):
        changed = data.replace(b"K\x02K\x03\x86", big + b"K\x03\x86")
        assert changed != data
        refused(changed)
    empty = npy({"a": np.zeros((0, 3))})
    changed = empty.replace(b"K\x00K\x03\x86", b"J\xff\xff\xff\xffK\x03\x86")
    assert changed != empty
    refused(changed, "cut off")
    refused(npy({"a": np.array([None, {}], dtype=object)}), "cut off")


def test_values_that_multiply_or_hold_themselves_are_refused():
    value: list = [1]
    for _ in range(30):
        value = [value, value]
    refused(npy(value), "two places")
    value = []
    value.append(value)
    refused(npy(value), "two places")
    array = np.zeros(1000)
    refused(npy([array] * 1000), "two places")


def test_keys_and_shapes_take_no_time():
    """A kilobyte or some: numbers and tuples that Python would compute with for minutes."""
    one = pickle.LONG1 + b"\xff" + b"\x7f" * 255 + pickle.BINPUT + b"\x63"
    many = (pickle.BINGET + b"\x63") * 60_000
    shape = pickle.MARK + one + many + pickle.TUPLE
    array = np.zeros(3)
    data = npy(array)
    place = data.index(b"K\x03\x85")  # the tuple of its shape
    with time_of_at_most(20):
        refused(data[:place] + shape + data[place + 3 :], "no such shape")
        for depth in (100, 200_000):
            data = npy({"a": 1})
            place = data.index(b"X\x01\x00\x00\x00a")
            key = pickle.EMPTY_TUPLE + pickle.TUPLE1 * depth
            refused(data[:place] + key + data[place + 6 :], "a key that is not a string")


@pytest.mark.parametrize("header", ["(" * 4000, "{'descr': '|O', 'shape': (", "\0", "[{}]"])
def test_headers_that_numpy_cannot_parse(header):
    words = header.encode("latin-1") + b"\n"
    refused(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(words)) + words, r"not a \.npy file")


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"\0" * (MAX_BYTES + 1), "more than"),
        (b"", r"not a \.npy file"),
        (b"not numpy at all", r"not a \.npy file"),
        (HEAD.replace(b"\x01\x00", b"\x02\x00", 1), r"not a \.npy file"),
        (HEAD.replace(b"'shape': (), ", b"'shape': (2,)"), r"holds an array of object \(2,\)"),
        (HEAD.replace(b"'|O'", b"'f8'"), r"holds an array of float64 \(\)"),
        (npy({})[:-3], "damaged"),
        (HEAD + pickle.dumps({}, 3), "contradict"),
    ],
)
def test_files_of_another_format_are_refused(data, why):
    refused(data, why)


@settings(deadline=None)
@given(st.binary(max_size=60), st.integers(0, 300))
def test_damage_anywhere_is_an_error_for_people_or_harmless(noise, at):
    data = npy({"a": np.arange(3.0), "b": [1, "x"]})
    at = len(HEAD) + at % (len(data) - len(HEAD))
    modules = set(sys.modules)
    said = "x.npy"
    try:
        load_npy_object(data[:at] + noise + data[at + len(noise) :], "x.npy")
    except DataError as error:
        said = str(error)
    assert "x.npy" in said
    assert set(sys.modules) == modules
