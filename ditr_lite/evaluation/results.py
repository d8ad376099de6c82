"""Results files: what stands in their head, and how they are written and read.

Every committed figure names the command that made it, the weights by their checksums and the versions of what it was
computed with, so that anybody can make it again and see whether it still belongs to the weights.
"""

import hashlib
import json
import platform
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..config import Config, to_dict
from ..files import write_json
from ..store import WEIGHTS, read_card, read_config


def head(
    command: str, weights: Path | str | None = None, parts: Sequence[str] | None = None, **notes: Any
) -> dict[str, Any]:
    """Return how a results file begins: command, checksums of the weights, versions, notes.

    Args:
        command: that makes the file again.
        weights: folder of the weights; None for the shipped ones.
        parts: the networks that the figures depend on; all by default.
        notes: whatever else should be known, e.g. the split.

    Raises:
        ValueError: for a folder without weights, or without one of ``parts``.
    """
    there = {name: part["sha256"] for name, part in read_card(weights)["parts"].items()}
    absent = [name for name in parts or () if name not in there]
    if absent:
        raise ValueError(f"{weights or WEIGHTS} holds no {', '.join(absent)}; it has {', '.join(there)}")
    checksums = {name: there[name] for name in parts or there}
    how = {"weights_sha256": checksums, "settings_sha256": settings_sum(weights), "versions": versions()}
    return {"command": command, **how, **notes}


def settings_sum(weights: Path | str | None = None) -> str:
    """Return a checksum of how these weights are used, but for the fit of ``std``: size, looks, threshold, steps ...

    Settings at their defaults do not count: a card that does not name them says the same.
    """
    ours, plain = to_dict(read_config(weights)), to_dict(Config())
    settings = {key: value for key, value in ours.items() if key != "std" and value != plain[key]}
    for key, value in settings.items():
        if isinstance(value, dict):
            settings[key] = {name: each for name, each in value.items() if each != plain[key][name]}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that figures depend on."""
    return {"python": platform.python_version(), "numpy": np.__version__, "torch": torch.__version__}


def tool_command(name: str, arguments: Sequence[str]) -> str:
    """Return the command line of ``tools/name.py`` as it can be typed again."""
    return shlex.join(["python", f"tools/{name}.py", *map(str, arguments)])


def write(path: Path | str, begin: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Write a results file, whole or not at all.

    Args:
        path: e.g. ``ditr_lite/weights/results_test.json``.
        begin: what :func:`head` returned.
        values: the figures.
    """
    write_json(path, {**begin, **values})


def results_path(name: str, folder: Path | str = WEIGHTS) -> Path:
    """Return where the committed results called ``name`` are, e.g. ``test``."""
    return Path(folder) / f"results_{name}.json"


def read(name: str, folder: Path | str = WEIGHTS) -> dict[str, Any]:
    """Read the committed results called ``name``.

    Raises:
        ValueError: when there are none.
    """
    path = results_path(name, folder)
    if not path.is_file():
        raise ValueError(f"no results in {path}: their command stands in the README or in the tool that makes them")
    return json.loads(path.read_text(encoding="utf-8"))


def provenance(report: Mapping[str, Any]) -> str:
    """Return in words which weights results belong to, and the command that makes them again."""
    if "weights_sha256" not in report:
        said = "made with networks of its own"  # that were trained for this purpose alone
    elif is_current(report):
        said = "made with these weights"
    else:
        said = "MADE WITH OTHER WEIGHTS; read it as a record of those"
    return f"{said}; again: {report['command']}"


def is_current(report: Mapping[str, Any], weights: Path | str | None = None) -> bool:
    """Return whether results were made with these weights and settings, by checksums.

    Those of results say which weights and settings they are of. That the code has not changed since is not asked.
    """
    return not outdated(report, weights)


def outdated(report: Mapping[str, Any], weights: Path | str | None = None) -> list[str]:
    """Return the parts that results name and that are other ones in these weights; "settings" where those differ."""
    there = {name: part["sha256"] for name, part in read_card(weights)["parts"].items()}
    parts = [name for name, checksum in report["weights_sha256"].items() if there.get(name) != checksum]
    settings = report.get("settings_sha256")  # older results do not have it
    return parts + ["settings"] * (settings is not None and settings != settings_sum(weights))
