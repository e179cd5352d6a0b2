"""npz files that others wrote: what their headers say is checked before anything is allocated or unpickled."""

import io
import pickle
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from mimic.base.npz import MAX_BYTES, MAX_TEXT, read_arrays

ARRAYS = {"a": np.arange(12.0).reshape(3, 4), "names": np.array(["x", "yz"]), "n": np.array(3)}
CENTRAL, END = b"PK\x01\x02", b"PK\x05\x06"


def npy(header, content=b""):
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


def header(descr="'<f8'", shape="(3, 4)"):
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"


def archive(content, method=zipfile.ZIP_DEFLATED):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        file.writestr("a.npy", content)
    return stream.getvalue()


def rejection(path, data):
    """The message for a file of these bytes; it must be one line, and nothing large may be allocated."""
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError) as error:
            read_arrays(path, tuple(ARRAYS))
        assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
    finally:
        tracemalloc.stop()
    assert str(error.value).splitlines() == [str(error.value)]
    return str(error.value)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_those_of_numpy(tmp_path, save):
    arrays = {
        **ARRAYS,
        "fortran": np.asfortranarray(ARRAYS["a"]),
        "empty": np.zeros((0, 7)),
        "big": ARRAYS["a"].astype(">f4"),
        "nothing": np.array(""),
        "long": np.zeros(MAX_TEXT // 8 + 1),  # beside text, whose own size is limited
    }
    save(tmp_path / "a.npz", **arrays)
    loaded = read_arrays(tmp_path / "a.npz", (*arrays, "missing"))
    assert loaded.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(loaded[name], array)
        assert loaded[name].dtype == array.dtype and loaded[name].flags.writeable


LIES = {
    "seven TiB": (header(shape=f"({10**12}, 1)"), "a states the shape (1000000000000, 1), which does not fit its 96 b"),
    "negative sizes": (header(shape="(-3, -4)"), "a states the shape"),
    "texts of 4 GB": (header("'<U500000000'", "(1,)"), "a states the shape"),
    "too few values": (header(shape="(3, 3)"), "a states the shape"),
    "objects": (header("'|O'"), "a has type object; expected numbers or text"),
    "records": (header("'<f8,<f8'"), "a has type"),
    "a call": ("__import__('os').getcwd()", "a is no array, or its header cannot be read"),
    "levels": ("(" * 9000, "a is no array, or its header cannot be read"),
}


@pytest.mark.parametrize("case", LIES)
def test_headers_that_lie_are_rejected(tmp_path, case):
    text, message = LIES[case]
    assert rejection(tmp_path / "a.npz", archive(npy(text, ARRAYS["a"].tobytes()))).startswith(message)


def good():
    stream = io.BytesIO()
    np.savez_compressed(stream, **ARRAYS)
    return stream.getvalue()


def with_field(mark, offset, form, value):
    data = bytearray(good())
    struct.pack_into(form, data, data.index(mark) + offset, value)
    return bytes(data)


ONE_TEXT = header("'<U1'", "(1,)")
DAMAGES = {
    "lzma": (lambda: archive(npy(header()), zipfile.ZIP_LZMA), "a has compression 14; expected stored or deflated"),
    "a size of 4 GB": (lambda: with_field(CENTRAL, 24, "<I", 2**32 - 2), "a states the shape"),
    "a checksum": (lambda: with_field(CENTRAL, 16, "<I", 1), "Bad CRC-32 for file 'a.npy'"),
    "a large directory": (lambda: with_field(END, 12, "<I", 2**31), "its directory has 2147483648 bytes, expected at"),
    "two names": (lambda: good().replace(b"names.npy", b"nomes.npy", 1), "File name in directory"),
    "truncated": (lambda: good()[:-30], "it is no zip archive, or its end is missing"),
    "a pickle": (lambda: pickle.dumps(ARRAYS), "it is no zip archive, or its end is missing"),
    "a line break in a name": (lambda: archive(npy(ONE_TEXT, b"\n\0\0\0")), "a has text that cannot be printed"),
    "no character": (lambda: archive(npy(ONE_TEXT, b"\xff" * 4)), ""),
    "much text": (
        lambda: archive(npy(header("'<U1'", f"({MAX_TEXT},)"), bytes(4 * MAX_TEXT))),
        f"a has {4 * MAX_TEXT} bytes",
    ),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_archives_are_rejected(tmp_path, case):
    make, message = DAMAGES[case]
    assert message in rejection(tmp_path / "a.npz", make())


def test_arrays_are_limited_together(tmp_path):
    """Each value counts 8 bytes at least, since callers convert to float64: a small file may have many."""
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(1000, np.int8), n=np.zeros(1000))
    assert len(read_arrays(tmp_path / "a.npz", ("a", "n"), 16_000)) == 2
    with pytest.raises(ValueError, match="its arrays are too large; expected at most .* GiB for n"):
        read_arrays(tmp_path / "a.npz", ("a", "n"), 15_999)
    assert MAX_BYTES == 2**30


def test_every_flipped_bit_is_noticed_or_harmless(tmp_path):
    data, rng = good(), np.random.default_rng(0)
    rejected = 0
    for _ in range(100):
        changed = bytearray(data)
        changed[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        (tmp_path / "a.npz").write_bytes(changed)
        try:
            loaded = read_arrays(tmp_path / "a.npz", ARRAYS)
        except ValueError as error:
            rejected += 1
            assert str(error).splitlines() == [str(error)]
            continue
        assert loaded.keys() == ARRAYS.keys()
        for name, array in loaded.items():
            np.testing.assert_array_equal(array, ARRAYS[name])
    assert rejected > 30
