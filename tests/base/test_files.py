"""The door for files: regular files alone, of a limited size, and no reader beside it."""

import ast
import os
import socket

import pytest

from mimic.arms.embodiment import planar_arm
from mimic.arms.model_files import read_model
from mimic.base import files
from mimic.base.config_files import read_config
from mimic.base.npz import read_arrays
from mimic.deploy.policy import open_session
from mimic.motions.demonstrations import load_demonstrations
from mimic.motions.formats.lerobot_reading import read_lerobot
from mimic.motions.formats.rosbag2 import read_rosbag2, write_rosbag2
from mimic.motions.importing import import_demonstrations
from mimic.motions.mocap.reading import KINDS, read_motion
from tests.helpers.episodes import EXPERT, episodes
from tests.helpers.repository import REPOSITORY

READERS = {
    "bytes": files.read_bytes,
    "text": files.read_text,
    "json": files.read_json,
    "digest": files.file_digest,
    "open": lambda path: files.open_file(path).close(),
    "check": files.check_file,
}
KINDS_OF_FILES = {"pipe": "a named pipe", "socket": "a socket", "folder": "a folder", "/dev/zero": "a device"}


@pytest.fixture
def special(tmp_path, monkeypatch, in_time):
    """A folder with a pipe, a socket and a folder."""
    monkeypatch.chdir(tmp_path)  # the name of a socket may have 100 characters
    os.mkfifo("pipe")
    (tmp_path / "folder").mkdir()
    with socket.socket(socket.AF_UNIX) as end:
        end.bind("socket")
        yield tmp_path


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", KINDS_OF_FILES)
def test_only_regular_files_are_read(special, reader, kind):
    expected = ValueError if reader == "check" or kind != "socket" else (ValueError, OSError)  # open() rejects sockets
    with pytest.raises(expected, match=f"expected a regular file, got {KINDS_OF_FILES[kind]}|No such device or addr"):
        READERS[reader](kind)


def test_sizes_are_limited(tmp_path):
    (tmp_path / "large").write_bytes(bytes(11))
    for reader in (files.read_bytes, files.read_text, files.open_file, files.check_file):
        with pytest.raises(ValueError, match="expected at most 10 bytes, got 11"):
            reader(tmp_path / "large", 10)
    assert files.read_bytes(tmp_path / "large", 11) == bytes(11)
    with pytest.raises(ValueError, match="expected at most 10 bytes"):  # its stated size is 0
        files.read_bytes("/proc/self/status", 10)


def test_content_is_read_through_links(tmp_path):
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbfone\r\ntwo\n")
    (tmp_path / "link").symlink_to("file")
    assert files.read_text(tmp_path / "link") == "one\ntwo\n"
    (tmp_path / "file").write_bytes(b"\xff")
    with pytest.raises(ValueError, match="expected text in UTF-8"):
        files.read_text(tmp_path / "file")


@pytest.mark.parametrize(
    ("text", "message"),
    [("[1]", r"expected an object, got \[1\]"), ("[" * 50_000, "not nested as deeply"), ("{", "Expecting")],
)
def test_json_is_an_object(tmp_path, text, message):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=message):
        files.read_json(tmp_path / "a.json")


# --- readers of files ---

ARM = planar_arm([0.5, 0.5])
FILE_READERS = {
    "model": ("a.xml", read_model),
    "config": ("a.yaml", read_config),
    "npz": ("a.npz", lambda path: read_arrays(path, ["a"])),
    "demonstrations": ("a.npz", load_demonstrations),
    "network": ("a.onnx", lambda path: open_session(path, {}, {})),
    **{
        f"motions{kind}": (f"a{kind}", lambda path: import_demonstrations(path, ARM))
        for kind in (".csv", ".csv.gz", ".npz", ".hdf5", ".db3", ".mcap")
    },
    **{f"capture{kind}": (f"a{kind}", read_motion) for kind in KINDS},
}


@pytest.mark.parametrize("reader", FILE_READERS)
def test_a_pipe_instead_of_a_file_is_rejected(tmp_path, in_time, reader):
    name, read = FILE_READERS[reader]
    os.mkfifo(tmp_path / name)
    with pytest.raises(ValueError) as error:
        read(tmp_path / name)
    assert str(error.value).splitlines() == [str(error.value)]


def replaced_by_pipe(path):
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("pattern", ["meta/info.json", "data/*/*.parquet", "meta/episodes/*/*.parquet"])
def test_a_pipe_in_a_lerobot_dataset_is_rejected(tmp_path, in_time, pattern):
    pytest.importorskip("pyarrow")
    from mimic.motions.formats.lerobot import write_lerobot

    write_lerobot(tmp_path, episodes())
    replaced_by_pipe(next(tmp_path.glob(pattern)))
    with pytest.raises(ValueError, match=r"cannot be read: expected a regular file, got a named pipe"):
        read_lerobot(tmp_path, EXPERT)


@pytest.mark.parametrize("pattern", ["*/metadata.yaml", "*/*.db3"])
def test_a_pipe_in_a_rosbag2_is_rejected(tmp_path, in_time, pattern):
    pytest.importorskip("rosbags")
    write_rosbag2(tmp_path, episodes())
    replaced_by_pipe(next(tmp_path.glob(pattern)))
    with pytest.raises(ValueError, match="cannot be read: .*: expected a regular file, got a named pipe"):
        read_rosbag2(tmp_path, EXPERT)


# --- no reader beside the door ---

# Functions and methods that open a file to read it, or that hand its path to a library; `open` is also the built-in.
OPENING = {
    *("open", "read_text", "read_bytes", "fromfile", "loadtxt", "genfromtxt", "memmap", "ZipFile", "copyfile", "copy2"),
    *("copytree", "from_file", "from_xml_path", "read_metadata", "read_schema", "read_table", "ParquetFile", "c3d"),
    *("AnyReader", "Reader", "h5py.File", "InferenceSession", "safe_load", "OmegaConf.load", "np.load"),
}
DOOR = "base/files.py"
ALLOWED = {  # by module and function, with the reason
    ("__main__.py", "file.read_text"): "our own modules",
    ("arms/model_files.py", "mujoco.MjSpec.from_file"): "our own models",
    ("base/npz.py", "archive.open"): "an entry of an open file",
    ("base/npz.py", "zipfile.ZipFile"): "of an open file",
    ("runs/parameters.py", "zipfile.ZipFile"): "of an open file",
    ("trainers/export/onnx_model.py", "onnxruntime.InferenceSession"): "of bytes",
    ("commands/fit.py", "Image.open"): "of an open file",
    ("deploy/policy.py", "onnxruntime.InferenceSession"): "of bytes",
    ("envs/__init__.py", "OmegaConf.load"): "our own presets",
    ("motions/formats/hdf5.py", "h5py.File"): "checked",
    ("motions/formats/hdf5_rewriting.py", "h5py.File"): "our own copy",
    ("motions/formats/lerobot_reading.py", "pq.ParquetFile"): "checked",
    ("motions/formats/lerobot_rewriting.py", "pq.ParquetFile"): "checked",
    ("motions/formats/lerobot_reading.py", "pq.read_metadata"): "checks",
    ("motions/formats/lerobot_reading.py", "pq.read_schema"): "checks",
    ("motions/formats/rosbag2.py", "Reader"): "checks",
    ("motions/formats/cells.py", "np.loadtxt"): "of lines",
    ("motions/mocap/c3d.py", "ezc3d.c3d"): "checked",
}


_NAMES = {called.rpartition(".")[2] for called in OPENING}


def _name(function):
    return getattr(function, "attr", "") or getattr(function, "id", "")


def opening_functions(source):
    """The functions in a module's text that open files to read them; calls that open a file to write do not count."""
    for node in ast.walk(ast.parse(source)):
        name = _name(node.func) if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Call) and name in _NAMES:
            called = ast.unparse(node.func)
            is_method = isinstance(node.func, ast.Attribute) or name in ("open", "Reader", "AnyReader")
            modes = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
            opens = is_method and not OPENING.isdisjoint((name, called))
            if opens and called != "os.open" and not {"w", "wb", "a", "a+", "x"}.intersection(modes):
                yield called


def test_no_reader_goes_past_the_door():
    package = REPOSITORY / "mimic"
    modules = {path.relative_to(package).as_posix(): path.read_text() for path in package.rglob("*.py")}
    assert "os.fdopen" in modules.pop(DOOR)
    found = {(module, called) for module, text in modules.items() for called in opening_functions(text)}
    assert found - set(ALLOWED) == set()


@pytest.mark.parametrize(
    "call", ["open(path)", "path.open()", "path.read_text()", "np.load(path)", "open(path, 'rb')", "shutil.copy2(a, b)"]
)
def test_a_reader_past_the_door_is_found(call):
    assert list(opening_functions(f"def read(path):\n    return {call}"))
    assert not list(opening_functions("open(path, 'w'), read_text(path), path.open('a', newline='')"))
