"""XLA's choices: kept with a run, used by the processes that resume it."""

import json

import jax
import pytest

from mimic.base.compilation import compilation_cache
from mimic.runs.autotuning import FILE, keep_choices, use_kept_choices

FOLDER = "xla_gpu_per_fusion_autotune_cache_dir"


@pytest.fixture
def cache(tmp_path):
    """Sets JAX's compilation cache; returns its folder."""
    before = compilation_cache()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    yield tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", before and str(before))


@pytest.fixture
def run_dir(tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    return path


def choose(cache, **contents):
    """Writes choices as XLA does."""
    for name, content in contents.items():
        path = cache / FOLDER / "device" / f"{name}.pb"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def chosen(cache):
    return {path.stem: path.read_bytes() for path in (cache / FOLDER).rglob("*.pb")}


def test_the_same_cache_is_used_as_it_is(cache, run_dir):
    choose(cache, a=b"\x00\xff", b=b"2")
    keep_choices(run_dir)
    choose(cache, c=b"of another run")
    use_kept_choices(run_dir)
    assert compilation_cache() == cache


@pytest.mark.parametrize("others", [{}, {"a": b"\x00\xff"}, {"a": b"other", "b": b"2"}])
def test_another_cache_is_not_mixed_with_the_choices_of_a_run(cache, run_dir, others):
    choose(cache, a=b"\x00\xff", b=b"2")
    keep_choices(run_dir)
    other = cache.with_name("other")
    choose(other, **others)
    jax.config.update("jax_compilation_cache_dir", str(other))
    use_kept_choices(run_dir)
    assert (compilation_cache() or cache).parent == other
    assert chosen(compilation_cache()) == {"a": b"\x00\xff", "b": b"2"}
    use_again = compilation_cache()
    jax.config.update("jax_compilation_cache_dir", str(other))
    use_kept_choices(run_dir)
    assert compilation_cache() == use_again


def test_later_choices_are_added_and_first_ones_stay(cache, run_dir):
    choose(cache, a=b"1")
    keep_choices(run_dir)
    choose(cache, a=b"changed", b=b"2")
    keep_choices(run_dir)
    kept = json.loads((run_dir / FILE).read_text())
    assert kept == {"device/a.pb": "MQ==", "device/b.pb": "Mg=="}


def test_nothing_is_kept_where_there_are_none(cache, run_dir):
    keep_choices(run_dir)
    assert list(run_dir.iterdir()) == []
    use_kept_choices(run_dir)
    assert compilation_cache() == cache


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"../../a": "MQ=="}', '{"/a": "MQ=="}', '{"a": 1}', '{"a": "?"}', '{"a/../../b": "MQ=="}']
)
def test_a_file_that_mimic_did_not_write_is_not_used(cache, run_dir, capsys, content):
    (run_dir / FILE).write_text(content)
    use_kept_choices(run_dir)
    assert compilation_cache() == cache and not cache.exists()
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "is not used" in error
