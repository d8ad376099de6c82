"""Weights on disk: safetensors with a checksum each, and one card that says how they came to be."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from .config import Config, from_dict, preset, to_dict
from .files import written_whole

WEIGHTS = Path(__file__).resolve().parent / "weights"
CARD = "card.json"


def sha256(path: Path | str) -> str:
    """Return the hexadecimal SHA-256 of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def fingerprint(module: nn.Module, *settings: float) -> str:
    """Return a checksum of a network's tensors and of the settings it is read with: what its output depends on."""
    digest = hashlib.sha1(repr(settings).encode())
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def read_card(folder: Path | str | None = None) -> dict[str, Any]:
    """Return the card of a weights folder: ``config`` and, per part, command, data, steps, time, curve, sha256.

    Raises:
        ValueError: when there is none, or it is not such a card.
    """
    path = Path(folder or WEIGHTS) / CARD
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"no weights in {path.parent}: expected {CARD} there; train them with `make train`") from None
    except ValueError as error:  # not JSON, or not even text
        raise ValueError(f"{path} is damaged ({error}); restore it or train again with `make train`") from None
    if not isinstance(card, dict) or not {"config", "parts"} <= card.keys():
        raise ValueError(f"{path} is no card of weights: it lacks config or parts; restore it")
    return card


def save_part(name: str, state: dict[str, Tensor], config: Config, folder: Path | str, notes: dict[str, Any]) -> Path:
    """Write one network as ``folder/name.safetensors`` (floating tensors as float16) and enter it into the card.

    Files appear whole or not at all.
    """
    folder = Path(folder)
    path = folder / f"{name}.safetensors"
    half = {k: (v.half() if v.is_floating_point() else v).contiguous().cpu() for k, v in state.items()}
    write_tensors(half, path)
    card = read_card(folder) if (folder / CARD).is_file() else {"parts": {}}
    card["config"] = to_dict(config)
    card["parts"][name] = {**notes, "sha256": sha256(path)}
    with written_whole(folder / CARD) as part:  # as plain JSON: a curve may hold NaN where nothing could be scored
        part.write_text(json.dumps(card, indent=1) + "\n")
    return path


def write_tensors(tensors: dict[str, Tensor], path: Path, metadata: dict[str, str] | None = None) -> None:
    """Write tensors as safetensors through a temporary name."""
    with written_whole(path) as part:
        save_file(tensors, str(part), metadata=metadata)


def load_part(name: str, folder: Path | str | None = None) -> dict[str, Tensor]:
    """Read one network's tensors as float32, after checking them against the card.

    Raises:
        ValueError: when the file is missing, or is not the one that the card describes.
    """
    folder = Path(folder or WEIGHTS)
    card, path = read_card(folder), folder / f"{name}.safetensors"
    if name not in card["parts"] or not path.is_file():
        raise ValueError(f"no weights called {name!r} in {folder}; train them with `make train`")
    if sha256(path) != card["parts"][name]["sha256"]:
        raise ValueError(f"{path} does not match its checksum in {CARD}: it is damaged or was replaced; restore it")
    try:
        tensors = load_file(str(path))
    except Exception as error:  # safetensors raises its own type for a malformed file
        raise ValueError(f"{path} cannot be read as safetensors: {error}") from None
    return {k: v.to(torch.float32) if v.is_floating_point() else v for k, v in tensors.items()}


def copy_weights(source: Path | str, folder: Path | str) -> None:
    """Copy a weights folder, its card last: until then the copy is none.

    Raises:
        ValueError: when there are no weights in ``source``.
    """
    source, folder = Path(source), Path(folder)
    card = read_card(source)
    for file in (*(f"{name}.safetensors" for name in card["parts"]), CARD):
        with written_whole(folder / file) as part:
            shutil.copyfile(source / file, part)


def load_parts(path: Path | str | None = None, name: str = "lite") -> tuple[Config, dict[str, dict[str, Tensor]]]:
    """Return the configuration and all tensors of a weights folder, by default the shipped one.

    Args:
        path: folder with ``card.json``; None for the shipped weights.
        name: preset the weights must have been trained with; only ``lite`` is shipped.

    Raises:
        ValueError: for an unknown preset, one without shipped weights, or missing or damaged files.
    """
    preset(name)
    if path is None and name != "lite":
        raise ValueError(
            f"only the lite preset is shipped with weights, not {name!r}; train it and give its folder as path"
        )
    card = read_card(path)
    config = from_dict(card["config"])
    names = ["region", "autoencoder", "optical", "geometric"] + (["detail"] if config.detail.width else [])
    return config, {part: load_part(part, path) for part in names}
