"""The keys of a command for its `--help`: the value of each, that of the preset where a key has none, and what it is.

What a key is comes from the docstring of its config class.
"""

import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf

from mimic.commands.config import RecordingConfig, RetargetConfig
from mimic.envs.config import DemonstrationConfig, EnvConfig
from mimic.trainers.config import PoseMapperConfig, PPOConfig, TrainConfig
from mimic.trainers.presets import MAPPER_PRESETS, PPO_PRESETS

_WIDTH, _COLUMN = 120, 38  # characters of a line, and in front of the explanation
_PRESETS: dict[type, dict[str, dict[str, Any]]] = {PPOConfig: PPO_PRESETS, PoseMapperConfig: MAPPER_PRESETS}
_REFERRED = {
    config.__name__: config for config in (TrainConfig, EnvConfig, DemonstrationConfig, RecordingConfig, RetargetConfig)
}
# References to the library, which say nothing on a command line.
_OF_LIBRARY = re.compile(r"(?:[,;] see| \(see) [\w.]+(?: for formats| in \S+)?\)?(?=$|[;,])")
_ATTRIBUTE = re.compile(r"^  (\w+(?:, \w+)*): (.*(?:\n    .*)*)", re.MULTILINE)  # of a docstring's section


def key_lines(node: DictConfig, indent: str = "") -> Iterator[str]:
    """The lines of a composed config: key, value and explanation, nested as in YAML."""
    config_class = OmegaConf.get_type(node)
    texts = explanations(config_class) if isinstance(config_class, type) else {}
    for key in node:
        child = node._get_node(key)
        text = texts.get(str(key), "")
        if isinstance(child, DictConfig) and not child._is_none():
            yield _line(f"{indent}{key}:", "" if text.startswith("see ") else text)
            yield from key_lines(child, f"{indent}  ")
        else:
            yield _line(f"{indent}{key}: {_value(node, str(key))}", text)


def explanations(config_class: type) -> dict[str, str]:
    """What each field of a config is, in one sentence, by the docstrings of its class and the classes below it."""
    texts: dict[str, str] = {}
    for base in reversed(config_class.__mro__):
        section = (inspect.getdoc(base) or "").partition("Attributes:\n")[2]
        for names, text in _ATTRIBUTE.findall(section):
            sentence = re.split(r"\.(?:\s|$)", " ".join(text.split()))[0].replace("`", "")
            texts |= {name: _OF_LIBRARY.sub("", _followed(name, sentence)) for name in names.split(", ")}
    return texts


def _followed(name: str, text: str) -> str:
    """The explanation that a text refers to, if it is no more than that."""
    reference = re.fullmatch(r"see (\w+)", text)
    if reference and reference[1] in _REFERRED:
        return explanations(_REFERRED[reference[1]]).get(name, text)
    return text


def _value(node: DictConfig, key: str) -> str:
    """A value as YAML; without one, that of the preset, or of each preset where JAX's backend chooses it."""
    if OmegaConf.is_missing(node, key):
        return "???"
    value = OmegaConf.to_container(node)[key]  # type: ignore[call-overload, index]
    config_class = OmegaConf.get_type(node)
    presets = _PRESETS.get(config_class, {}) if isinstance(config_class, type) else {}
    if value is None and any(key in preset for preset in presets.values()):
        if node["preset"] in presets:
            return _yaml(presets[node["preset"]].get(key))
        names: dict[str, list[str]] = {}  # of the presets, by value
        for name, preset in presets.items():
            if key in preset:
                names.setdefault(_yaml(preset[key]), []).append(name)
        if len(names) > 1:
            return ", ".join(f"{value} ({', '.join(some)})" for value, some in names.items())
        return next(iter(names))
    return _yaml(value)


def _yaml(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=float("inf"))
    return text.removesuffix("...\n").strip()


def _line(assignment: str, text: str) -> str:
    if not text:
        return assignment
    start = f"{assignment:<{_COLUMN}}  # "
    return start + textwrap.shorten(text, max(_WIDTH - len(start), _COLUMN), placeholder=" ...")
