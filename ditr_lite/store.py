"""Weights on disk: safetensors with a checksum each, and one card that says how they came to be."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from .config import Config, from_dict, preset, to_dict
from .files import locked, read_json, written_whole

WEIGHTS = Path(__file__).resolve().parent / "weights"
CARD = "card.json"
BUILT_ON = {  # part -> the parts that it was trained on and is no use without
    "optical": ("autoencoder", "encoder"),
    "geometric": ("autoencoder", "encoder"),
    "detail": ("autoencoder",),
}


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
    if not path.is_file():
        raise ValueError(f"no weights in {path.parent}: expected {CARD} there; the shipped ones are in {WEIGHTS}")
    try:
        card = read_json(path)
    except ValueError as error:  # not JSON, or not even text
        raise ValueError(f"{path} is damaged ({error}); restore it or train again with `make train`") from None
    if not {"config", "parts"} <= card.keys():
        raise ValueError(f"{path} is no card of weights: it lacks config or parts; restore it")
    parts = card["parts"]
    if not isinstance(card["config"], dict) or not isinstance(parts, dict):
        raise ValueError(f"{path} is damaged: config and parts should be JSON objects; restore it")
    for name, part in parts.items():
        if not isinstance(part, dict) or not isinstance(part.get("sha256"), str):
            raise ValueError(f"{path} is damaged: part {name!r} should be an object with a sha256; restore it")
        if not isinstance(part.get("built_on", {}), dict) or Path(name).name != name:
            raise ValueError(f"{path} is damaged: part {name!r} cannot be of this kind; restore it")
    return card


def read_config(folder: Path | str | None = None) -> Config:
    """Return the configuration that the card of a weights folder holds.

    Raises:
        ValueError: when there is no card, or its configuration cannot be.
    """
    card = read_card(folder)
    try:
        return from_dict(card["config"])
    except (ValueError, TypeError, AttributeError, KeyError, ZeroDivisionError, OverflowError) as error:
        raise ValueError(f"{Path(folder or WEIGHTS) / CARD} is damaged: config is none ({error}); restore it") from None


def save_part(name: str, state: dict[str, Tensor], config: Config, folder: Path | str, notes: dict[str, Any]) -> Path:
    """Write one network as ``folder/name.safetensors`` (floating tensors as float16) and enter it into the card.

    Files appear whole or not at all, and no other writer's entry is lost. The entry says by their checksums on which
    parts of the folder this one was trained, unless ``notes`` do (``built_on``).

    Raises:
        ValueError: for tensors with NaN or infinity.
        OSError: when a file cannot be written.
    """
    folder = Path(folder)
    path = folder / f"{name}.safetensors"
    half = {k: (v.half() if v.is_floating_point() else v).contiguous().cpu() for k, v in state.items()}
    _check_finite(name, half, "training went wrong: lower its learning rate")
    with locked(folder / CARD):
        card = {"parts": {}}
        if (folder / CARD).is_file():
            card, config = read_card(folder), calibrated(config, read_config(folder))
        below = {n: card["parts"][n]["sha256"] for n in BUILT_ON.get(name, ()) if n in card["parts"]}
        write_tensors(half, path)
        card["config"] = to_dict(config)
        card["parts"][name] = {"built_on": below, **notes, "sha256": sha256(path)}
        _write_card(card, folder)
    return path


def _write_card(card: dict[str, Any], folder: Path) -> None:
    """Write the card of a folder as plain JSON: a curve may hold NaN where nothing could be scored."""
    with written_whole(folder / CARD) as part:
        part.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def calibrated(config: Config, there: Config) -> Config:
    """Return ``config`` with what calibration entered into the card that is there: training a part does not undo it."""
    refine = replace(config.refine, temperature=there.refine.temperature)
    return replace(config, refine=refine, std=there.std)


def _check_finite(name: str, tensors: dict[str, Tensor], advice: str) -> None:
    """Refuse tensors with NaN or infinity."""
    if wrong := [k for k, v in tensors.items() if v.is_floating_point() and not torch.isfinite(v).all()]:
        raise ValueError(f"the weights of {name!r} hold NaN or infinity in {wrong[0]}: {advice}")


def write_tensors(tensors: dict[str, Tensor], path: Path, metadata: dict[str, str] | None = None) -> None:
    """Write tensors as safetensors through a temporary name, readable by whoever may read other files of this user."""
    with written_whole(path) as part:
        part.touch()
        mode = part.stat().st_mode
        try:
            save_file(tensors, str(part), metadata=metadata)  # for the owner's eyes only
            part.chmod(mode)
        except SafetensorError as error:  # a full disk, too
            raise OSError(f"cannot write {path}: {error}") from None


def load_part(name: str, folder: Path | str | None = None) -> dict[str, Tensor]:
    """Read one network's tensors as float32, after checking them against the card.

    Raises:
        ValueError: when the file is missing, is not the one that the card describes, holds NaN, or was trained on
            another autoencoder or encoder than is in the folder.
    """
    folder = Path(folder or WEIGHTS)
    card, path = read_card(folder), folder / f"{name}.safetensors"
    if name not in card["parts"] or not path.is_file():
        raise ValueError(
            f"no weights called {name!r} in {folder}; train them with `make train`, or copy "
            f"the shipped ones there: store.copy_part({name!r}, store.WEIGHTS, {str(folder)!r})"
        )
    if sha256(path) != card["parts"][name]["sha256"]:
        raise ValueError(f"{path} does not match its checksum in {CARD}: it is damaged or was replaced; restore it")
    for other, checksum in card["parts"][name].get("built_on", {}).items():
        if other in card["parts"] and card["parts"][other]["sha256"] != checksum:
            raise ValueError(
                f"the weights in {folder} do not belong together: {name!r} was trained on another {other!r} than is "
                f"there; restore that, or train {name!r} again"
            )
    try:
        tensors = load_file(str(path))
    except Exception as error:  # safetensors raises its own type for a malformed file
        raise ValueError(f"{path} cannot be read as safetensors: {error}") from None
    _check_finite(name, tensors, "restore them or train again")
    return {k: v.to(torch.float32) if v.is_floating_point() else v for k, v in tensors.items()}


def copy_part(name: str, source: Path | str, folder: Path | str, config: Config | None = None) -> None:
    """Copy one part with its entry in the card into ``folder``, unless it is there already or ``source`` is it.

    Args:
        name: of the part.
        source: weights folder.
        folder: for the copy.
        config: of a folder that has no card yet; the source's by default.
    """
    folder = Path(folder)
    if (folder / CARD).is_file():
        if name in read_card(folder)["parts"] and (folder / f"{name}.safetensors").is_file():
            return
        config = read_config(folder)
    card = read_card(source)
    state = load_part(name, source)
    save_part(name, state, config or read_config(source), folder, card["parts"][name])


def copy_weights(source: Path | str, folder: Path | str, config: Config | None = None) -> None:
    """Copy a weights folder, its card last: until then the copy is none.

    Args:
        source: folder with ``card.json``.
        folder: for the copy.
        config: that the copy is to be used with, of networks of the same sizes; the source's by default.

    Raises:
        ValueError: when there are no weights in ``source``.
    """
    source, folder = Path(source), Path(folder)
    card = read_card(source)
    for name in card["parts"]:
        with written_whole(folder / f"{name}.safetensors") as part:
            shutil.copyfile(source / f"{name}.safetensors", part)
    _write_card(card if config is None else card | {"config": to_dict(config)}, folder)


def load_parts(path: Path | str | None = None, name: str | None = None) -> tuple[Config, dict[str, dict[str, Tensor]]]:
    """Return the configuration and all tensors of a weights folder, by default the shipped one.

    Args:
        path: folder with ``card.json``; None for the shipped weights.
        name: preset that the weights must be of; None for whichever they are.

    Raises:
        ValueError: for an unknown preset or one that the weights are not of, or missing, damaged or mixed weights.
    """
    if name is not None:
        preset(name)
    config = read_config(path)
    if name is not None and config.name != name:
        where = "shipped with weights" if path is None else f"what {path} holds"
        raise ValueError(
            f"only the {config.name} preset is {where}, not {name!r}; train it and give its folder as path"
        )
    names = ["region", "autoencoder", "optical", "geometric"]
    names += ["encoder"] if config.unet.colour_channels else []
    names += ["detail"] if config.detail.width else []
    return config, {part: load_part(part, path) for part in names}


def usable_device(name: str | torch.device) -> torch.device:
    """Return a device of torch by its name.

    Raises:
        ValueError: when it is not there, or cannot be used.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError, TypeError) as error:
        raise ValueError(f"device {name!r} cannot be used here ({str(error).splitlines()[0]}); choose 'cpu'") from None
    return device


# What a reader's own parts must return: checked where they are called; the shipped ones pass through the same checks.


def checked_sampler(sampler: Callable) -> Callable:
    """Return a sampler with a ValueError for anything but finite latents of the shape that was asked for.

    Raises:
        ValueError: at once, for what cannot be called.
    """
    if not callable(sampler):
        raise ValueError(f"sampler: expected a call like diffusion.sample, got {sampler!r}")

    def call(predict, shape, *args, **options) -> Tensor:
        drawn = sampler(predict, shape, *args, **options)
        if not isinstance(drawn, Tensor) or drawn.shape != shape:
            got = tuple(drawn.shape) if isinstance(drawn, Tensor) else type(drawn).__name__
            raise ValueError(f"sampler: expected a tensor {tuple(shape)} of latents, got {got}")
        if not drawn.is_floating_point():
            raise ValueError(f"sampler: expected latents of floating-point numbers, got {drawn.dtype}")
        if not torch.isfinite(drawn).all():
            raise ValueError("sampler: the latents hold NaN or infinity; a denoiser that returns such leads there, too")
        return drawn.float()

    return call


def checked_denoiser(net: nn.Module, branch: str) -> nn.Module:
    """Return the denoiser of a branch.

    Raises:
        ValueError: when it lacks one of the two calls that stage two makes.
    """
    if not callable(net) or not callable(getattr(net, "features", None)):
        raise ValueError(
            f"the {branch} denoiser should have two calls, features(image, colour) and net(x, t, features, masked, "
            f"known); {type(net).__name__} lacks one"
        )
    return net


def checked_logits(found: Any, classes: int, like: Tensor) -> Tensor:
    """Return the logits (B, classes, H, W) that a stage one returned, for pictures of the size of ``like``.

    Raises:
        ValueError: for anything but a dictionary with finite logits of that shape.
    """
    logits = found.get("logits") if isinstance(found, dict) else None
    expected = (len(like), classes, *like.shape[2:])
    if not isinstance(logits, Tensor) or logits.shape != expected or not logits.is_floating_point():
        got = f"logits {tuple(logits.shape)} {logits.dtype}" if isinstance(logits, Tensor) else type(found).__name__
        raise ValueError(f"stage one: expected a dictionary with float logits {expected}, got {got}")
    if not torch.isfinite(logits).all():
        raise ValueError("stage one: the logits hold NaN or infinity")
    return logits
