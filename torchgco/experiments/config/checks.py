"""Checks of a composed configuration: its groups, keys and names. Parts check their own options."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from torchgco.base.errors import InputError
from torchgco.base.options import Seed, check_value
from torchgco.experiments.config.groups import config_dir, options_of
from torchgco.experiments.results.identity import CLOSED_LOOP

NAME_PATTERN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}")  # part of the names of files and folders
MODEL = ("dimension", "vehicle")
VEHICLE_GROUP = "vehicle"  # the group of airframes that the model of a quadrotor brings along
NO_CHOICES = ("null", "true", "false", "")  # values that Hydra reads as no name
PATH_KEYS = ("scenario.path", "hydra.run.dir", "hydra.sweep.dir")  # keys whose values are paths, of any letters


def hydra_words(words: Iterable[str]) -> list[str]:
    """The words of a command line as Hydra takes them: `~mission` for `mission=null`, paths without `~` and quoted, the
    number of a device as that of its name.

    Raises:
        InputError: a value that is no name, where the word chooses an option of a group, or a row of a list to delete:
            Hydra fails there.
    """
    return [part for word in words for part in _of_numbered(_hydra_word(word))]


def _of_numbered(word: str) -> list[str]:
    """A word for a device, or a sweep over some, with the number of each, such as `device=cuda:1`, as two words: Hydra
    has a file for its kind alone."""
    numbered = re.fullmatch(r"device=((?:cuda:\d+,?)+)", word.replace("\\:", ":"))  # as a sweep writes its jobs' words
    return [word] if numbered is None else ["device=cuda", f"device.name={numbered[1]}"]


def _hydra_word(word: str) -> str:
    if word.startswith("-"):  # a flag, where words alone are taken
        folder = "; a folder of configs is 'hydra.searchpath=[file://FOLDER]' there" if "config" in word else ""
        raise InputError("overrides", f"KEY=VALUE or GROUP=OPTION{folder}", word)
    if re.fullmatch(r"~[\w.]+\.\d+", word):  # Hydra fails there, too
        raise InputError(word[1:], "a key: a row of a list can be changed by its index, but not deleted", word)
    key, equals, value = word.lstrip("+").partition("=")
    if key in PATH_KEYS and equals:
        return f"{word.partition('=')[0]}={_hydra_path(key, value)}"
    group = key.split("@")[0]
    if equals and re.fullmatch(r"[\w/]+", group) and (options := options_of(group)):
        if value.lower() == "null" and _default_options(_read("config")).get(key, "") is None:
            return f"~{key}"
        if value.lower() in NO_CHOICES or re.fullmatch(r"[-+]?[\d.]+|\{.*\}", value):
            raise InputError(group, f"one of {', '.join(options)}", value or "nothing")
    return word


def _hydra_path(key: str, value: str) -> str:
    """A path, or several to sweep over, with homes in place of `~`; quoted where Hydra would read no text in it."""
    value = ",".join(os.path.expanduser(path) for path in value.split(","))
    try:
        read = OverridesParser.create().parse_override(f"{key}={value}")
        if "${" in value or read.is_sweep_override() or isinstance(read.value(), str | None):
            return value
    except HydraException:
        pass
    slashed = re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + ("\\'" if match[2] else ""), value)
    return f"'{slashed}'"


def check_once(words: Iterable[str]) -> None:
    """Check that no key is given twice: Hydra would take the last value without a warning.

    Raises:
        InputError: a key that is.
    """
    values: dict[str, str] = {}
    for word in words:
        key, equals, _ = word.lstrip("+").partition("=")
        if equals and key in values:
            raise InputError(key, "one value", f"{values[key]} and {word}")
        values[key] = word


def _read(name: str) -> Any:
    """A file of conf/ as plain dicts and lists."""
    return OmegaConf.to_container(OmegaConf.load(config_dir() / f"{name}.yaml"))


def _default_options(base: Any) -> dict[str, str | None]:
    """The option of every group in the defaults list of config.yaml; None where the group is left out by default."""
    return {key: option for entry in base["defaults"] if isinstance(entry, dict) for key, option in entry.items()}


def check(config: Mapping[str, Any]) -> None:
    """Check the groups, keys and names of a resolved configuration, without its node `hydra`.

    Raises:
        InputError: a group or key that is missing or unknown, a malformed seed, name or list of baselines.
    """
    base = _read("config")
    chosen = _default_options(base).items()
    groups = {key: option for key, option in chosen if key.isidentifier() and key != "experiment"}
    base_keys = [key for key in base if key not in ("defaults", "hydra")]
    needed = [*base_keys, *(key for key, option in groups.items() if option is not None)]
    _keys(config, "", needed, [*base_keys, *groups, VEHICLE_GROUP])
    device = _read(f"device/{groups['device']}")
    for name, known in (("study", base["study"]), ("device", device), ("model", MODEL)):
        _keys(config[name], name, list(known), list(known))
    for name in ("scenario", "solver"):
        _keys(config[name], name, ["_target_"])
    _keys(config["model"]["vehicle"], "model.vehicle", ["_target_", "name"])
    check_value(config["seed"], Seed, "seed")
    _name(config["solver"].get("name"), "solver.name")
    _name(config["model"]["vehicle"]["name"], "model.vehicle.name")
    if "path" not in config["scenario"]:
        _name(config["scenario"].get("name"), "scenario.name")
    _baselines(config["study"]["baselines"])


def _keys(node: Any, group: str, needed: Sequence[str], known: Sequence[str] = ()) -> None:
    """Check that `node` is a group with the needed keys and, where others are known at all, with no unknown ones."""
    if not isinstance(node, Mapping):
        raise InputError(group, "a group of keys", repr(node))
    inside = f"{group}." if group else ""
    for name in needed:
        if name not in node:
            raise InputError(f"{inside}{name}", "this key in the configuration", "none")
    for name in node if known else ():
        if name not in known:
            raise InputError(f"{inside}{name}", f"one of the keys {', '.join(known)}", name)


def _name(value: Any, field: str) -> None:
    if not isinstance(value, str) or not NAME_PATTERN.fullmatch(value):
        expected = "at most 64 letters, digits, '_', '-' and '.', which isn't the first"
        raise InputError(field, expected, repr(value))


def _baselines(names: Any) -> None:
    if not isinstance(names, list | None) or not all(isinstance(name, str) for name in names or ()):
        raise InputError("study.baselines", "a list of solver names, such as [al_ilqr]", repr(names))
    if len(set(names or ())) < len(names or ()):
        raise InputError("study.baselines", "each name once", repr(names))


def as_input_error(error: BaseException, field: str = "configuration") -> InputError:
    """An error of Hydra or OmegaConf as one line that names the key; keys of the error lie below `field`."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, InputError):
            return cause
        cause = cause.__cause__ or cause.__context__  # OmegaConf drops the cause of a failed interpolation
    if isinstance(error, OverrideParseException):
        return _unread(error.override)
    options = error.options if isinstance(error, MissingConfigException) else None
    if isinstance(error, MissingConfigException) and options:
        group, _, option = str(error.missing_cfg_file).rpartition("/")
        return InputError(group, f"one of {', '.join(options)}", option)
    if folder := re.match(r"Additional config directory '(.+)' not found", str(error)):
        return InputError("--config-dir", "a folder of configurations", f"{folder[1]}, which doesn't exist")
    text = "\n".join((str(error), *getattr(error, "__notes__", ())))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if unknown := re.match(r"Could not override '(.+?)'", lines[0] if lines else ""):
        return _unknown_key(error, unknown[1])
    if merged := re.match(r"Error merging override \+*([^=\s]+)=?(.*)", lines[0] if lines else ""):
        return InputError(merged[1], "a value of the kind that the configuration has", merged[2] or _joined(error))
    inside = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("full_key:")), "")
    key = getattr(error, "full_key", None) or ".".join(filter(None, (field, inside)))
    if absent := re.search(r"Error locating target '(.+?)'", str(error)):
        return _not_found(error, key, absent[1])
    if extra := re.search(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(.+?)'", str(error)):
        return InputError(f"{key}.{extra[2]}", f"an option that {extra[1]} has", extra[2])
    return InputError(str(key) or field, "a value that the configuration knows", _joined(error))


def _unread(word: str) -> InputError:
    """The error for a word that Hydra's grammar refuses."""
    key, equals, value = word.partition("=")
    if not equals or not re.fullmatch(r"[+~]*[\w./@-]+", key):
        return InputError("command line", "KEY=VALUE or GROUP=OPTION (--help lists them)", word)
    expected = f"a value, quoted where it has other letters than names: \"{key}='...'\""
    return InputError(key.lstrip("+~"), expected, value)


def _not_found(error: BaseException, key: str, target: str) -> InputError:
    """The error for a `_target_` that can't be imported, with the reason of Python."""
    reason = error
    while (cause := reason.__cause__ or reason.__context__) is not None:
        reason = cause
    why = f"{target} ({type(reason).__name__}: {_joined(reason)})"
    kind, at = ("function", key) if key.startswith("study.metrics.") else ("class", f"{key}._target_")
    return InputError(at, f"a {kind} that Python can import (PYTHONPATH=. for a module of this folder)", why)


def _unknown_key(error: BaseException, key: str) -> InputError:
    """The error for an unknown key: it names the first part that the configuration lacks, and the key most like it."""
    cause: Any = error.__cause__  # of OmegaConf
    key = str(getattr(cause, "full_key", None) or key)
    name, parent = key.rpartition(".")[2], cause.parent_node if hasattr(cause, "parent_node") else None
    if key in CLOSED_LOOP:
        return InputError(key, "experiment=mission, as its keys are given", "none")
    if key.split(".")[0] == VEHICLE_GROUP and not (isinstance(parent, DictConfig) and "mass" in parent):
        return InputError(key, "model=quadrotor, whose airframe this is", "another model")
    if key.startswith("model.vehicle.dynamics.airframe."):
        return InputError(key, f"{VEHICLE_GROUP}.{name}, as airframes have a group of their own", name)
    known = [str(other) for other in parent] if isinstance(parent, DictConfig) else []
    near = get_close_matches(name, known, n=1)
    where = " (docs/options.md has the options of all solvers)" if key.startswith("solver.") else ""
    expected = "a key that the configuration has" + "".join(f", such as {other}" for other in near)
    return InputError(key, expected, name + where)


def _joined(error: BaseException) -> str:
    """The text of an error in one line, without the places that it is about."""
    lines = [line.strip() for line in str(error).splitlines()]
    return " ".join(line for line in lines if line and not line.startswith(("full_key:", "object_type=")))
