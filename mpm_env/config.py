"""Files that describe scenes, materials and fidelities: found, read, overlaid, and refused in one sentence."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

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


def find(kind: str, name: str, beside: Path = Path()) -> Path:
    """The file of a shipped name, or of a path of one's own ending in .yaml, looked for in a folder first."""
    if name.endswith((".yaml", ".yml")):
        for path in (beside / name, Path(name)):
            if path.is_file():
                return path
        raise ValueError(f"There is no file {name}.")
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
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}.") from None
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
        except (KeyError, IndexError, ValueError, TypeError):
            raise ValueError(f"The setting {path!r} names nothing here; {_known_in(node)}.") from None
        except yaml.YAMLError:
            raise ValueError(f"The value in {setting!r} cannot be read.") from None


def _known_in(node: Any) -> str:
    names = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else []
    return f"known at that place: {', '.join(map(str, names))}" if names else "there is nothing below that place"


def parse(schema: type[T], data: dict[str, Any], name: str) -> T:
    """Data as a checked configuration; the first fault becomes one sentence that names file, key, value and bound.

    Types are strict: a number in quotes, or a yes where a number belongs, is refused and not converted.
    """
    try:
        return schema.model_validate_json(json.dumps(data, default=_plain), strict=True)
    except ValidationError as error:
        raise ValueError(f"{name}: {_sentence(schema, error)}") from None


def _plain(value: Any) -> Any:
    """What JSON has no word for: arrays as lists, anything else as its text, which the schema then refuses."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _sentence(schema: type[BaseModel], error: ValidationError) -> str:
    faults = error.errors(include_url=False)
    # A misspelt key that is required is two faults, missing and unknown: the unknown one has the hint.
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    steps, beside = _walk(schema, fault["loc"])
    place = ".".join(steps)
    if fault["type"] == "extra_forbidden":
        return f"unknown key {place!r}{nearest(steps[-1], beside)}"
    if fault["type"] == "missing":
        return f"the key {place!r} is missing."
    if fault["type"] in ("union_tag_not_found", "union_tag_invalid"):
        return f"{place} {_tag_sentence(fault['ctx'])}"
    message = fault["msg"].removeprefix("Value error, ").removeprefix("Input ").rstrip(".")
    got = fault["input"]
    shown = f", got {got!r}" if fault["type"] != "value_error" and not isinstance(got, dict | list) else ""
    return f"{place} {message}{shown}." if place else f"{message}{shown}."


def _tag_sentence(context: dict[str, Any]) -> str:
    key = context["discriminator"].strip("'")
    if "tag" not in context:
        return f"needs the key {key!r}."
    known = [tag.strip("' ") for tag in context["expected_tags"].split(",")]
    return f"has no {key} {context['tag']!r}{nearest(context['tag'], known)}"


def _walk(schema: Any, loc: tuple[int | str, ...]) -> tuple[list[str], list[str]]:
    """The steps to a fault as they stand in the file, and the keys that the schema knows where the last one is."""
    models, steps = [schema], []
    for step in loc:
        beside = list(dict.fromkeys(key for m in models for key in m.model_fields))
        tagged = [m for m in models if any(step in get_args(f.annotation) for f in m.model_fields.values())]
        if step not in beside and tagged:  # the tag of a union: pydantic's word, not the file's
            models = tagged
            continue
        steps.append(str(step))
        if step in beside:
            models = [
                k for m in models if step in m.model_fields for k in _models_in(m.model_fields[str(step)].annotation)
            ]
    return steps, beside if loc else []


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in getattr(annotation, "__args__", ()) for m in _models_in(arg)]
