"""Files that describe scenes, materials and fidelities: found, read, overlaid, and refused in one sentence."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

T = TypeVar("T", bound=BaseModel)


class Section(BaseModel):
    """A part of a configuration file: unknown keys are refused, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Loader(yaml.SafeLoader):
    """YAML as people write numbers: 5e-5 is one, although YAML 1.1 asks for 5.0e-5."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d[\d_]*\.?[\d_]*|\.[\d_]+)([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)


def folder() -> Path:
    """Where the shipped configurations are, in a checkout or in an installed wheel."""
    here = Path(__file__).resolve().parent
    return next(p for p in (here / "configs", here.parent / "configs") if p.is_dir())


def known(kind: str) -> list[str]:
    """Names of the shipped files of a kind: "scenes", "materials" or "fidelities"."""
    return sorted(p.stem for p in (folder() / kind).glob("*.yaml"))


def find(kind: str, name: str) -> Path:
    """The file of a shipped name, or of a path of one's own ending in .yaml."""
    if name.endswith((".yaml", ".yml")):
        path = Path(name)
        if not path.is_file():
            raise ValueError(f"There is no file {name}.")
        return path
    if name not in known(kind):
        raise ValueError(f"There is no {kind[:-1].replace('ie', 'y')} {name!r}{nearest(name, known(kind))}")
    return folder() / kind / f"{name}.yaml"


def nearest(name: str, names: Sequence[str]) -> str:
    """The end of a sentence about an unknown name: the nearest known one, and all of them."""
    close = difflib.get_close_matches(name, names, n=1)
    hint = f": did you mean {close[0]!r}?" if close else "."
    return f"{hint} Known: {', '.join(names)}."


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file."""
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not YAML: {' '.join(str(error).split())}.") from None
    if not isinstance(data, dict):
        raise ValueError(f"{path} must hold keys and values, got {type(data).__name__}.")
    return data


def overlay(data: dict[str, Any], settings: Sequence[str]) -> None:
    """Change nested data in place by settings like "grains.0.material.E=1e6"; a new leaf is left to the schema."""
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals or not path:
            raise ValueError(f"A setting is key=value, got {setting!r}.")
        keys = path.split(".")
        node: Any = data
        try:
            for key in keys[:-1]:
                node = node[int(key)] if isinstance(node, list) else node[key]
            value = yaml.load(text, _Loader)
            if isinstance(node, list):
                node[int(keys[-1])] = value
            elif isinstance(node, dict):
                node[keys[-1]] = value
            else:
                raise KeyError(keys[-1])
        except (KeyError, IndexError, ValueError):
            names = list(node) if isinstance(node, dict) else [str(i) for i in range(len(node or []))]
            raise ValueError(f"The setting {path!r} names nothing here; known at that place: {names}.") from None
        except yaml.YAMLError:
            raise ValueError(f"The value in {setting!r} cannot be read.") from None


def parse(schema: type[T], data: dict[str, Any], name: str) -> T:
    """Data as a checked configuration; the first fault becomes one sentence that names file, key, value and bound."""
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        raise ValueError(f"{name}: {_sentence(schema, error)}") from None


def _sentence(schema: type[BaseModel], error: ValidationError) -> str:
    fault = error.errors(include_url=False)[0]
    place = ".".join(str(p) for p in fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"unknown key {place!r}{nearest(str(fault['loc'][-1]), _keys_beside(schema, fault['loc']))}"
    if fault["type"] == "missing":
        return f"the key {place!r} is missing."
    message = fault["msg"].removeprefix("Value error, ").removeprefix("Input ").rstrip(".")
    got = fault["input"]
    shown = f", got {got!r}" if fault["type"] != "value_error" and not isinstance(got, dict | list) else ""
    return f"{place} {message}{shown}." if place else f"{message}{shown}."


def _keys_beside(schema: Any, loc: tuple[int | str, ...]) -> list[str]:
    """The keys a schema knows at the place of an unknown one; nothing where the place has no fixed keys."""
    fields: dict[str, Any] = {}
    pending: list[Any] = [schema]
    for step in (*loc[:-1], None):
        models = [m for t in pending for m in _models_in(t)]
        if step is None:
            for m in models:
                fields.update(m.model_fields)
        elif any(isinstance(step, str) and step in m.model_fields for m in models):
            pending = [m.model_fields[step].annotation for m in models if step in m.model_fields]
        else:  # a list index, or the tag of a union
            tagged = [m for m in models if any(f.default == step for f in m.model_fields.values())]
            pending = list(tagged or models)
    return list(fields)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in getattr(annotation, "__args__", ()) for m in _models_in(arg)]
