"""PCD files written here, plain and compressed, and what damaged ones say."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.datasets.clouds.pcd import lzf_decompress, parse_pcd, read_pcd
from qs3.errors import DataError, MissingDataError

CLOUDS = Path(__file__).resolve().parents[4] / "shared" / "data" / "kinect_v1"
LETTERS = {"i": "I", "u": "U", "f": "F"}


def lzf_compress(data):
    """The longest match of the last 8 KiB, found by brute force over three-byte keys."""
    out, literals, seen, i = bytearray(), bytearray(), {}, 0

    def flush():
        while literals:
            part = literals[:32]
            out.append(len(part) - 1)
            out.extend(part)
            del literals[:32]

    while i < len(data):
        key = data[i : i + 3]
        start = seen.get(key) if len(key) == 3 else None
        seen[key] = i
        if start is None or i - start > 8192:
            literals.append(data[i])
            i += 1
            continue
        length = 3
        while i + length < len(data) and length < 264 and data[start + length] == data[i + length]:
            length += 1
        flush()
        distance = i - start - 1
        first, more = (min(length - 2, 7) << 5) | distance >> 8, length - 9
        out.extend([first, more] if length - 2 >= 7 else [first])
        out.append(distance & 255)
        i += length
    flush()
    return bytes(out)


def pcd(fields, width, height, data, header=None):
    """The bytes of a file; `header` replaces or removes (None) lines by their key."""
    arrays = {n: np.asarray(a) for n, a in fields.items()}
    counts = [a.shape[1] if a.ndim == 2 else 1 for a in arrays.values()]
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(arrays),
        "SIZE": " ".join(str(a.itemsize) for a in arrays.values()),
        "TYPE": " ".join(LETTERS[a.dtype.kind] for a in arrays.values()),
        "COUNT": " ".join(map(str, counts)),
        "WIDTH": width,
        "HEIGHT": height,
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": width * height,
        "DATA": data,
    }
    lines |= header or {}
    text = "# .PCD v0.7 - Point Cloud Data file format\n"
    text += "".join(f"{k} {v}\n" for k, v in lines.items() if v is not None)
    if data == "ascii":
        table = zip(*(a.reshape(len(a), -1).tolist() for a in arrays.values()), strict=True)
        body = "\n".join(" ".join(f"{v!r}" for part in row for v in part) for row in table)
        return text.encode() + body.encode() + b"\n"
    if data == "binary":
        rows = [np.ascontiguousarray(a).view(np.uint8).reshape(len(a), -1) for a in arrays.values()]
        return text.encode() + np.concatenate(rows, axis=1).tobytes()
    plain = b"".join(a.tobytes() for a in arrays.values())
    packed = lzf_compress(plain)
    sizes = np.array([len(packed), len(plain)], "<u4").tobytes()
    return text.encode() + sizes + packed


def cloud(n=12, seed=0):
    rng = np.random.default_rng(seed)
    z = rng.normal(2, 0.5, n).astype(np.float32)
    z[0] = np.nan
    return {
        "label": rng.integers(0, 99, n).astype(np.uint32),
        "x": rng.normal(size=n).astype(np.float32),
        "y": rng.normal(size=n),
        "z": z,
        "tag": rng.integers(-128, 128, n).astype(np.int8),
        "h": rng.normal(size=(n, 3)).astype(np.float32),
    }


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_what_is_written_is_read(data, tmp_path):
    fields = cloud()
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(fields, 4, 3, data))
    read = read_pcd(path)
    assert (read.width, read.height) == (4, 3)
    for name in "xyz":
        assert read.fields[name].dtype == fields[name].dtype
        np.testing.assert_array_equal(read.fields[name], fields[name])
    np.testing.assert_array_equal(read.image("z")[1], fields["z"][4:8])
    np.testing.assert_array_equal(read.xyz()[:, 1], fields["y"])
    assert read.fields["z"].flags.writeable


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400), st.integers(1, 40))
def test_lzf_returns_what_was_compressed(data, times):
    plain = data * times
    assert lzf_decompress(lzf_compress(plain), len(plain)) == plain


def test_lzf_by_hand():
    """Three letters, then 9 + 4 bytes from 3 back, which overlap; then 2 bytes from 1 back."""
    packed = bytes([2]) + b"abc" + bytes([7 << 5, 4, 2]) + bytes([1 << 5, 0])
    assert lzf_decompress(packed, 19) == b"abcabcabcabcabca" + b"aaa"
    with pytest.raises(DataError, match="before their beginning"):
        lzf_decompress(bytes([0]) + b"a" + bytes([1 << 5, 1]), 4)
    for cut in (1, 5, 6, 8):
        with pytest.raises(DataError, match="damaged"):
            lzf_decompress(packed[:cut], 19)
    with pytest.raises(DataError, match="came out of 18"):
        lzf_decompress(packed, 18)


def test_padding_and_missing_optional_lines():
    fields = {"x": np.arange(3.0), "_": np.zeros((3, 5), np.uint8), "z": np.arange(3) + 0.5}
    optional = dict.fromkeys(("POINTS", "VIEWPOINT", "VERSION"))
    read = parse_pcd(pcd(fields, 3, 1, "binary", optional))
    assert list(read.fields) == ["x", "z"]
    np.testing.assert_array_equal(read.fields["z"], [0.5, 1.5, 2.5])
    with pytest.raises(DataError, match="without y"):
        read.xyz()
    with pytest.raises(DataError, match="not an image"):
        read.image("z")


SMALL = {"x": np.zeros(4, np.float32), "i": np.arange(4, dtype=np.uint8)}
DAMAGED = [
    ("no line DATA", {"DATA": None}, "binary"),
    ("ascii, binary", {"DATA": "pickle"}, "binary"),
    ("version '0.6'", {"VERSION": "0.6"}, "binary"),
    ("4 POINTS, but 2 x 1", {"WIDTH": 2}, "binary"),
    ("WIDTH that is not", {"WIDTH": "-4"}, "binary"),
    ("0 values in HEIGHT", {"HEIGHT": None}, "binary"),
    ("unknown type 'F' with 2", {"SIZE": "2 1"}, "binary"),
    ("unknown type 'O'", {"TYPE": "O U"}, "binary"),
    ("COUNT of 0", {"COUNT": "0 1"}, "binary"),
    ("1 value in SIZE, not 2", {"SIZE": "4"}, "binary"),
    ("1 value in TYPE", {"TYPE": "F"}, "binary"),
    ("two fields called 'x'", {"FIELDS": "x x"}, "binary"),
    ("no fields", {"FIELDS": ""}, "binary"),
    ("does not know: 'EVAL x'", {"VERSION": "0.7\nEVAL x"}, "binary"),
    ("is cut: it has 20 of the 25", {"WIDTH": 5, "POINTS": 5}, "binary"),
    ("is cut: it has 20 of the 4999999995", {"WIDTH": 999999999, "POINTS": 999999999}, "binary"),
    ("do not fit", {"WIDTH": 99, "POINTS": 99}, "ascii"),
    ("8 numbers where its header promises 10", {"WIDTH": 5, "POINTS": 5}, "ascii"),
    ("'x' that uint8 does not hold", {"TYPE": "U U", "SIZE": "1 1"}, "ascii"),
    ("than a number in the field 'x'", {"FIELDS": "i x", "TYPE": "U F", "SIZE": "1 4"}, "ascii"),
    ("states 20 bytes", {"WIDTH": 5, "POINTS": 5}, "binary_compressed"),
]


@pytest.mark.parametrize(("message", "header", "data"), DAMAGED)
def test_damaged_headers_say_what_is_wrong(message, header, data, tmp_path):
    path = tmp_path / "bad.pcd"
    content = pcd({**SMALL, "x": SMALL["x"] + 300}, 4, 1, data, header)
    path.write_bytes(content.replace(b" 3", b" three") if "than a number" in message else content)
    with pytest.raises(DataError, match=message) as error:
        read_pcd(path)
    assert "bad.pcd" in str(error.value)


def test_compressed_sizes_are_checked_before_memory_is_taken():
    whole = pcd(SMALL, 4, 1, "binary_compressed")
    start = whole.index(b"compressed\n") + len(b"compressed\n")
    for message, sizes in (("is cut: it has", [999, 20]), ("more than LZF can", [0, 20])):
        bad = whole[:start] + np.array(sizes, "<u4").tobytes() + whole[start + 8 :]
        with pytest.raises(DataError, match=message):
            parse_pcd(bad)
    with pytest.raises(DataError, match="no sizes"):
        parse_pcd(whole[: start + 7])


def test_a_word_of_a_million_letters_and_a_missing_file(tmp_path):
    text = pcd(SMALL, 4, 1, "ascii").replace(b"0.0 0", b"1" * 1_000_000 + b" 0", 1)
    with pytest.raises(DataError, match="more than 64"):
        parse_pcd(text)
    with pytest.raises(MissingDataError, match="no such file"):
        read_pcd(tmp_path / "none.pcd")


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_a_changed_or_cut_file_gives_a_cloud_or_a_data_error(data):
    """Never another exception."""
    kind = data.draw(st.sampled_from(["ascii", "binary", "binary_compressed"]))
    whole = bytearray(pcd(cloud(6), 3, 2, kind))
    for _ in range(data.draw(st.integers(0, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(whole)) | st.just(len(whole)))
    try:
        read = parse_pcd(bytes(whole[:end]))
    except DataError:
        return
    for column in read.fields.values():
        assert len(column) == read.width * read.height


@pytest.mark.skipif(not CLOUDS.is_dir(), reason="the real clouds are not here")
def test_a_real_cloud():
    read = read_pcd(CLOUDS / "learn0.pcd")
    assert (read.width, read.height) == (640, 480)
    u = np.arange(640) - 319.5
    x, z = read.image("x"), read.image("z")
    good = np.isfinite(z)
    assert 0.5 < good.mean() < 0.7
    np.testing.assert_allclose((525 * x / z)[good], np.broadcast_to(u, z.shape)[good], atol=1e-3)
