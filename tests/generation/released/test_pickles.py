"""A stranger's pickle gives numbers, or an error; it never runs anything."""

import builtins
import io
import os
import pickle
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from qs3.errors import DataError
from qs3.generation.released.pickles import MAX_BYTES, load_npy_object, loads

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(max_size=8)
    | st.binary(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text(max_size=4), inner, max_size=4)
    ),
    max_leaves=20,
)


def npy(value) -> bytes:
    file = io.BytesIO()
    np.save(file, value, allow_pickle=True)
    return file.getvalue()


@given(PLAIN, st.integers(0, 4))
def test_plain_values_come_back(value, protocol):
    assert loads(pickle.dumps(value, protocol), "x") == value


@given(
    hnp.arrays(
        st.sampled_from(["<f8", "<f4", ">i2", "u1", "<i8", "?"]),
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
    ),
    st.integers(0, 4),
    st.booleans(),
)
def test_arrays_come_back_as_numpy_itself_reads_them(array, protocol, transposed):
    data = pickle.dumps(array.T if transposed else array, protocol)
    ours, theirs = loads(data, "x"), pickle.loads(data)
    # numpy may turn the bytes of a value round on the way: the value is what counts
    assert ours.dtype.newbyteorder("=") == theirs.dtype.newbyteorder("=")
    assert ours.shape == theirs.shape
    np.testing.assert_array_equal(ours, theirs)


def test_numpy_scalars_and_objects_in_arrays_come_back():
    value = {"a": np.float32(1.5), "b": np.array([{"q": np.int64(3)}, None], dtype=object)}
    back = loads(pickle.dumps(value, 3), "x")
    assert back["a"] == 1.5
    assert back["b"].tolist() == [{"q": 3}, None]


def test_both_names_of_numpys_module_are_known():
    data = pickle.dumps(np.arange(3.0), 2)
    assert b"numpy.core.multiarray" in data
    renamed = data.replace(b"numpy.core.multiarray", b"numpy._core.multiarray")
    np.testing.assert_array_equal(loads(renamed, "x"), [0, 1, 2])


def test_a_npy_file_of_one_object_comes_back():
    value = {"obj_scale": np.ones(3), "camera_location": [np.arange(3.0)] * 5, "camera_lens": 50.0}
    back = load_npy_object(npy(value), "x.npy")
    assert back.keys() == value.keys()
    np.testing.assert_array_equal(back["camera_location"], value["camera_location"])


class Run:
    """Calls a function when it is unpickled."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize("wrap", [lambda v: v, lambda v: {"a": [1, (v,)]}], ids=["bare", "nested"])
def test_functions_are_refused_and_not_run(tmp_path, protocol, wrap):
    victim = tmp_path / "gone"
    for value, name in (
        (Run(os.system, f"touch {victim}"), r"posix\.system"),
        (Run(builtins.eval, f"open({str(victim)!r}, 'w')"), r"_*builtins?_*\.eval"),
        (Run(os.mkdir, str(victim)), r"posix\.mkdir"),
        (Run(np.load, str(victim)), r"numpy.*load"),
        (Run(pickle.loads, b"N."), r"_?pickle\.loads"),
    ):
        data = pickle.dumps(wrap(value), protocol)
        with pytest.raises(DataError, match=rf"bad\.npy.*asks for {name}.*nothing is run"):
            loads(data, "bad.npy")
    assert not victim.exists()


def test_the_same_pickle_would_have_run(tmp_path):
    """The attack of the tests above is a real one."""
    victim = tmp_path / "made"
    pickle.loads(pickle.dumps(Run(os.mkdir, str(victim))))
    assert victim.exists()


def test_a_function_inside_a_npy_file_is_refused(tmp_path):
    victim = tmp_path / "gone"
    array = np.array({"obj_scale": Run(os.mkdir, str(victim))}, dtype=object)
    with pytest.raises(DataError, match=r"posix\.mkdir"):
        load_npy_object(npy(array), "bad.npy")
    assert not victim.exists()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"cbuiltins\n__import__\n.", "asks for builtins.__import__"),
        (b"cnumpy\nload\n.", "asks for numpy.load"),
        (b"cnumpy.core.multiarray\n_reconstruct.__globals__\n.", "asks for"),
        (b"\x80\x04\x8c\x05numpy\x8c\x0cndarray.dump\x93.", "asks for numpy.ndarray.dump"),
        # bytes(2_000_000_000) would be 2 GB of zeros
        (b"c__builtin__\nbytes\n(J\xff\xff\xff\x7ftR.", "damaged"),
        (b"P1\n.", "PERSID"),
        (b"\x82\x01.", "EXT1"),
        (b"(ios\nsystem\n.", "INST"),
        (b"cnumpy\nndarray\n)\x81.", "NEWOBJ"),
        # called as numpy never does: would reserve 8 TB
        (b"cnumpy\nndarray\n(J\xff\xff\xff\x7ftR.", "does not use"),
        (b"cnumpy\ndtype\n(X\x0b\x00\x00\x00V2000000000tR.", "only numbers"),
        (b"cnumpy\ndtype\n(X\x02\x00\x00\x00f8tR(K\x03X\x01\x00\x00\x00<K\x01NNtb.", "fields"),
        # changing a stand-in for the files that follow
        (b"cnumpy\nndarray\n}X\x05\x00\x00\x00_makeNsb.", "gives a state to a name"),
        (b"cnumpy\ndtype\n(N}X\x05\x00\x00\x00_makeNstb.", "gives a state to a name"),
        (b"cnumpy\nndarray\n.", "neither plain nor an array"),
        (b"r\xff\xff\xff\x7f.", "damaged"),
        (b"Nr\xff\xff\xff\x7f.", "memo entry"),
        (b"\x8b\xff\xff\xff\x7f.", "damaged"),
        (b"N", "damaged"),
        (b".", "damaged"),
        (b"", "damaged"),
    ],
)
def test_crafted_pickles_are_refused(data, why):
    with pytest.raises(DataError, match=why):
        loads(data, "bad.npy")
    # and leave nothing behind
    np.testing.assert_array_equal(loads(pickle.dumps(np.arange(3), 3), "x"), [0, 1, 2])


def test_arrays_that_promise_more_than_they_hold_are_refused():
    data = pickle.dumps(np.arange(6.0).reshape(2, 3), 3)
    for big in (b"\xff\xff\xff\x7f", b"\x03\x00\x00\x00", b"\xff\xff\xff\xff"):
        changed = data.replace(b"K\x02K\x03\x86", b"J" + big + b"K\x03\x86")
        assert changed != data
        with pytest.raises(DataError, match=r"cut off|has the shape"):
            loads(changed, "x")
    objects = pickle.dumps(np.array([None, None], dtype=object), 3)
    changed = objects.replace(b"K\x02\x85", b"K\x07\x85")
    assert changed != objects
    with pytest.raises(DataError, match="cut off"):
        loads(changed, "x")


def test_values_that_multiply_or_hold_themselves_are_refused():
    value: list = [1]
    for _ in range(18):
        value = [value, value]
    with pytest.raises(DataError, match="too many values"):
        loads(pickle.dumps(value), "x")
    value = []
    value.append(value)
    with pytest.raises(DataError, match="nested too deeply"):
        loads(pickle.dumps(value), "x")


def test_large_files_are_refused_before_they_are_read():
    with pytest.raises(DataError, match="more than"):
        loads(b"\0" * (MAX_BYTES + 1), "x")
    with pytest.raises(DataError, match="more than"):
        load_npy_object(b"\0" * (MAX_BYTES + 1), "x")


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "no .npy file"),
        (b"not numpy at all", "no .npy file"),
        (npy(np.zeros(3)), r"holds an array of float64 \(3,\)"),
        (npy(np.array([{}, {}], dtype=object)), "not one pickled object"),
        (npy({})[:-3], "damaged|cut off"),
        (npy({})[:128] + pickle.dumps({}), "contradict"),
    ],
)
def test_files_of_another_format_are_refused(data, why):
    with pytest.raises(DataError, match=why):
        load_npy_object(data, "x.npy")


@given(st.binary(max_size=60), st.integers(0, 300))
def test_damage_anywhere_is_an_error_for_people_or_harmless(noise, at):
    data = pickle.dumps({"a": np.arange(3.0), "b": [1, "x"]}, 3)
    at %= len(data)
    damaged = data[:at] + noise + data[at + len(noise) :]
    said = "x.npy"
    try:
        loads(damaged, "x.npy")
    except DataError as error:
        said = str(error)
    assert "x.npy" in said


def test_memory_asked_for_by_length_prefixes_is_not_given():
    for code in (b"B", b"X", b"T"):
        with pytest.raises(DataError, match="damaged"):
            loads(code + struct.pack("<I", 2**31 - 1) + b"abc.", "x")
