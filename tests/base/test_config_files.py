"""Config files of others: bounded in size, aliases and references; no resolver is called."""

import pytest
from omegaconf import OmegaConf

from mimic.base.config import to_dict
from mimic.base.config_files import check_references, read_config
from mimic.trainers.config import TrainConfig
from mimic.trainers.run_config import load_config

BOMB = "a: &a [1, 1]\nb: [*a, *a]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, r"expected no aliases, got \*a"),
        ("a: &a [*a]", r"expected no aliases, got \*a"),
        ("[" * 700, "not nested as deeply"),
        ("a: " + "x" * 60_000, "expected at most 50,000 bytes, got 60,003"),
        ("a: 1\na: 2", "found duplicate key a"),
        ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
        ("[1]", r"expected keys and values, got \[1\]"),
        ("", "expected keys and values, got None"),
        ("? {a: 1}\n: 2", "unhashable key"),
    ],
    ids=["bomb", "itself", "deep", "large", "duplicate", "object", "list", "empty", "mapping as key"],
)
def test_hostile_yaml_is_rejected_in_one_line(tmp_path, text, message):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_config(tmp_path / "config.yaml")
    assert "\n" not in str(error.value)


REJECTED = "${oc.env:SECRET_TOKEN}", "${a.${seed}}", r"\${oc.env:SECRET_TOKEN}", "${oc.decode:1}", "${now:%Y}"


@pytest.mark.parametrize("text", REJECTED)
def test_only_references_to_keys_are_accepted(text):
    with pytest.raises(ValueError, match=r"run.dir\[1\]: expected no \$\{\.\.\.\} other than a reference to a key"):
        check_references(OmegaConf.create({"seed": 1, "run": {"dir": ["x", text]}}))


def test_references_to_keys_are_accepted_up_to_a_number():
    accepted = {
        "seed": 1,
        "run_dir": "runs/${seed}/${env.name}-${.seed}-${env.locked[0]}",
        "cost": "5 $",
        "shell": "$x",
    }
    check_references(OmegaConf.create(accepted))
    with pytest.raises(ValueError, match="expected at most 8 references"):
        check_references(OmegaConf.create({"a": "${b}" * 9, "b": 1}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trainer: {name: ppo}\nrun_dir: ${oc.env:SECRET_TOKEN}", "run_dir: expected no"),
        ("trainer: {name: ppo}\nenv: {metric: '${oc.env:SECRET_TOKEN}'}", "env.metric: expected no"),
        (BOMB, "aliases"),
        ("trainer: {name: ppo}\nenv: null", "env: expected keys and values, got None"),
        ("trainer: {name: ppo, entropy_cost: .nan}", "trainer.entropy_cost: expected a number from 0 to 1000, got nan"),
        ("trainer: {name: ppo}\nenv: {substeps: 1000000000}", "env.substeps: expected a whole number from 1 to 1,000"),
    ],
)
def test_the_config_of_a_run_is_guarded(tmp_path, monkeypatch, text, message):
    monkeypatch.setenv("SECRET_TOKEN", "not-for-others")
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        load_config(tmp_path)
    assert "not-for-others" not in str(error.value)


def test_references_to_keys_work_in_the_config_of_a_run(tmp_path):
    (tmp_path / "config.yaml").write_text("trainer: {name: ppo}\nseed: 3\nrun_dir: runs/${seed}\n")
    assert load_config(tmp_path).run_dir == "runs/3"


@pytest.mark.parametrize("text", ["distributed: ${seed}", "env: {metric: '${env.demonstrations}'}", "env: ${seed}"])
def test_references_to_keys_of_another_kind_are_rejected(tmp_path, text):
    (tmp_path / "config.yaml").write_text(f"trainer: {{name: ppo}}\nseed: 3\n{text}\n")
    with pytest.raises(ValueError, match="cannot be read: "):
        load_config(tmp_path)


def test_text_of_a_config_is_saved_as_it_is(monkeypatch):
    monkeypatch.setenv("SECRET_TOKEN", "not-for-others")
    assert to_dict(TrainConfig(run_dir="${oc.env:SECRET_TOKEN}"))["run_dir"] == "${oc.env:SECRET_TOKEN}"
