"""npz files that others wrote: what their headers say is checked before anything is allocated or unpickled."""

import io
import pickle
import struct
import time
import tracemalloc
import zipfile

import numpy as np
import pytest

from mimic.base.npz import MAX_BYTES, MAX_TEXT, read_arrays

ARRAYS = {"a": np.arange(12.0).reshape(3, 4), "names": np.array(["x", "yz"]), "n": np.array(3)}
LOCAL, CENTRAL, END = b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"


def npy(header, content=b"", version=1):
    text = header.encode() + b"\n"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text + content


def header(descr="'<f8'", shape="(3, 4)", order="False"):
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}"


def archive(method=zipfile.ZIP_DEFLATED, **contents):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as file:
        for name, content in contents.items():
            file.writestr(f"{name}.npy", content)
    return stream.getvalue()


def rejection(path, data):
    """The message for a file of these bytes; it must be one line, and nothing large may be allocated."""
    path.write_bytes(data)
    tracemalloc.start()
    began = time.perf_counter()
    try:
        with pytest.raises(ValueError) as error:
            read_arrays(path, ("a", "names", "n"))
        assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
    finally:
        tracemalloc.stop()
    assert time.perf_counter() - began < 10
    assert str(error.value).splitlines() == [str(error.value)]
    return str(error.value)


def test_text_beside_large_arrays_is_read(tmp_path):
    np.savez(tmp_path / "a.npz", qpos=np.zeros(MAX_TEXT // 8 + 1), arm=np.array("panda"))
    assert read_arrays(tmp_path / "a.npz", ("qpos", "arm"))["arm"] == "panda"


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_those_of_numpy(tmp_path, save):
    arrays = {
        **ARRAYS,
        "fortran": np.asfortranarray(ARRAYS["a"]),
        "empty": np.zeros((0, 7)),
        "big": ARRAYS["a"].astype(">f4"),
        "nothing": np.array(""),
        "many": np.random.default_rng(0).normal(size=(300, 1000)),
    }
    save(tmp_path / "a.npz", **arrays)
    loaded = read_arrays(tmp_path / "a.npz", (*arrays, "missing"))
    assert loaded.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(loaded[name], array)
        assert loaded[name].dtype == array.dtype and loaded[name].flags.writeable


LIES = {
    "seven TiB": (header(shape=f"({10**12}, 1)"), "a states 8000000000000 bytes, its entry has "),
    "more than a number": (header(shape=f"({2**62}, {2**62})"), "a states "),
    "a negative size": (header(shape="(-3, 4)"), "the header of a cannot be read"),
    "a true size": (header(shape="(True, 4)"), "the header of a cannot be read"),
    "texts of 4 GB": (header("'<U500000000'", "(1,)"), "a states 2000000000 bytes"),
    "objects": (header("'|O'"), "it has pickled objects"),
    "records": (header("'<f8,<f8'"), "a has type"),
    "dates": (header("'<M8[s]'"), "a has type"),
    "fields": (header("[('x', '<f8')]"), "the header of a cannot be read"),
    "a call": ("__import__('os').getcwd()", "the header of a cannot be read"),
    "levels": ("(" * 9000, "the header of a cannot be read"),
    "a long header": (" " * 20_000, "a has a header of 20001 bytes, expected at most 10000"),
    "too few values": (header(shape="(3, 3)"), "a states 72 bytes, its entry has 96"),
}


@pytest.mark.parametrize("case", LIES)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_headers_that_lie_are_rejected(tmp_path, case, method):
    text, message = LIES[case]
    assert rejection(tmp_path / "a.npz", archive(method, a=npy(text, ARRAYS["a"].tobytes()))).startswith(message)


def good():
    stream = io.BytesIO()
    np.savez_compressed(stream, **ARRAYS)
    return stream.getvalue()


def with_field(mark, offset, form, value):
    data = bytearray(good())
    struct.pack_into(form, data, data.index(mark) + offset, value)
    return bytes(data)


DAMAGES = {
    "encrypted": (lambda: with_field(CENTRAL, 8, "<H", 1), "'a.npy' is encrypted"),
    "strongly encrypted": (lambda: with_field(CENTRAL, 8, "<H", 0x40), "'a.npy' is encrypted"),
    "lzma": (lambda: archive(zipfile.ZIP_LZMA, a=npy(header())), "'a.npy' has compression 14; expected stored or defl"),
    "bzip2": (lambda: archive(zipfile.ZIP_BZIP2, a=npy(header())), "'a.npy' has compression 12; expected"),
    "an unknown compression": (lambda: with_field(CENTRAL, 10, "<H", 99), "'a.npy' has compression 99; expected"),
    "a size of 4 GB": (lambda: with_field(CENTRAL, 24, "<I", 2**32 - 2), "'a.npy' states 4294967294 bytes, more than"),
    "a checksum": (lambda: with_field(CENTRAL, 16, "<I", 1), "Bad CRC-32 for file 'a.npy'"),
    "a large directory": (lambda: with_field(END, 12, "<I", 2**31), "its directory has 2147483648 bytes, expected at"),
    "two names": (lambda: good().replace(b"names.npy", b"nomes.npy", 1), "File name in directory"),
    "truncated": (lambda: good()[:-30], "it is no zip archive, or its end is missing"),
    "empty": (lambda: b"", "it is no zip archive, or its end is missing"),
    "a pickle": (lambda: pickle.dumps(ARRAYS), "it is no zip archive, or its end is missing"),
    "one array": (lambda: npy(header(), ARRAYS["a"].tobytes()), "it has a single array"),
    "no array": (lambda: archive(a=b"text"), "a is no array"),
    "a line break in a name": (lambda: archive(a=npy(header("'<U1'", "(1,)"), b"\n\0\0\0")), "a has text that cannot"),
    "half a character": (lambda: archive(a=npy(header("'<U1'", "(1,)"), b"\x00\xd8\0\0")), "a has text that cannot"),
    "no character": (lambda: archive(a=npy(header("'<U1'", "(1,)"), b"\xff" * 4)), "a has text that cannot be printed"),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_archives_are_rejected(tmp_path, case):
    make, message = DAMAGES[case]
    assert rejection(tmp_path / "a.npz", make()).startswith(message)


def test_an_entry_of_the_same_name_is_rejected(tmp_path):
    with pytest.warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(tmp_path / "b.npz", "w") as file:
        for _ in range(2):
            file.writestr("a.npy", npy(header(), ARRAYS["a"].tobytes()))
    assert rejection(tmp_path / "a.npz", (tmp_path / "b.npz").read_bytes()) == "it has two entries 'a.npy'"


def test_small_files_of_many_values_are_rejected(tmp_path):
    """Each value counts 8 bytes at least, since callers convert to float64 and to Python's texts."""
    count = 2 * MAX_TEXT
    zeros = archive(a=npy(header("'<U1'", f"({count},)"), bytes(4 * count)))
    assert len(zeros) < count / 10
    assert "bytes of text; expected at most" in rejection(tmp_path / "a.npz", zeros)
    count = MAX_BYTES // 8 + 1
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file, file.open("a.npy", "w") as entry:
        entry.write(npy(header("'|i1'", f"({count},)")))
        for start in range(0, count, 2**20):
            entry.write(bytes(min(2**20, count - start)))
    assert "its arrays need 1 GiB; expected at most 1 GiB" in rejection(tmp_path / "a.npz", stream.getvalue())


def test_every_flipped_bit_is_noticed_or_harmless(tmp_path):
    data, rng = good(), np.random.default_rng(0)
    rejected = 0
    for _ in range(300):
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
    assert rejected > 100
