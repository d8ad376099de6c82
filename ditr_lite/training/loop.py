"""The training loop that every part shares: moving-average weights, checkpoints, exact resume, a log."""

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor, nn
from tqdm.auto import tqdm

from ..store import write_tensors


@dataclass(frozen=True)
class Recipe:
    """How long and how fast one part trains.

    Raises:
        ValueError: for no step, no frame, or a negative or infinite rate.
    """

    steps: int
    batch: int
    lr: float
    warmup: int = 100
    decay: float = 0.995  # of the moving average of the weights
    weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 1:
            raise ValueError(f"expected at least 1 step and 1 frame a step, got {self.steps} steps, batch {self.batch}")
        if not 0 <= self.lr < float("inf"):  # at 0 only running statistics move; NaN fails too
            raise ValueError(f"expected a finite learning rate of at least 0, got {self.lr}")


def learning_rate(step: int, recipe: Recipe) -> float:
    """Return the rate at a step: linear warm-up, then half a cosine down to a hundredth."""
    if step < recipe.warmup:
        return recipe.lr * (step + 1) / recipe.warmup
    progress = (step - recipe.warmup) / max(1, recipe.steps - recipe.warmup)
    return recipe.lr * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * progress)))


def fit(
    name: str,
    model: nn.Module,
    step_loss: Callable[[int], dict[str, Tensor]],
    recipe: Recipe,
    folder: Path | str,
    validate: Callable[[], dict[str, float]] | None = None,
    every: int = 500,
    seed: int = 0,
    progress: bool = True,
    key: str = "",
) -> dict[str, Any]:
    """Train ``model`` in place and leave it with its moving-average weights.

    A checkpoint (weights, average, optimiser) is written to ``folder`` every ``every`` steps; a later call with the
    same arguments goes on from it. Step k draws the same numbers whether or not training was interrupted before it.
    Only ``recipe.steps`` may be larger than before: what is left is then done at the rates of the longer run.

    Args:
        name: of the part; names the files.
        model: trained in place.
        step_loss: step -> losses, of which ``total`` is minimised.
        recipe: steps, batch and rate.
        folder: for checkpoints and the log ``name.jsonl``.
        validate: returns figures to log, taken with the averaged weights.
        every: steps between checkpoints.
        seed: of torch's generator.
        progress: show a bar.
        key: of all that decides the weights besides recipe and seed, such as scenes and the weights at the start; a
            checkpoint with another key is not taken.

    Returns:
        ``steps``, ``seconds`` of wall time, and the ``curve`` of logged figures.

    Raises:
        ValueError: for a checkpoint of another run or of a model of other sizes, or a damaged one.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoint, log = folder / f"{name}.checkpoint.safetensors", folder / f"{name}.jsonl"
    parameters = [p for p in model.parameters() if p.requires_grad]
    optimiser = torch.optim.AdamW(parameters, lr=recipe.lr, weight_decay=recipe.weight_decay)
    average = {k: v.clone() for k, v in model.state_dict().items()}
    first, spent, curve, run = 0, 0.0, [], _run(recipe, seed, key)
    if checkpoint.is_file():
        tensors = _read(checkpoint, run, recipe.steps)
        try:
            first = _restore(tensors, model, average, optimiser, parameters)
        except (RuntimeError, KeyError):  # torch's message is a page of tensor names
            raise ValueError(f"{checkpoint} is of other sizes: delete it, or use another folder") from None
        curve = [row for row in map(json.loads, log.read_text().splitlines()) if row["step"] <= first]
        spent = curve[-1]["seconds"] if curve else 0.0
    started = time.monotonic()
    model.train()
    bar = {} if progress else {"disable": True}  # left to tqdm's own default otherwise
    for step in tqdm(range(first, recipe.steps), name, recipe.steps, initial=first, unit="step", **bar):
        torch.manual_seed(seed * 1_000_003 + step)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(step, recipe)
        losses = step_loss(step)
        optimiser.zero_grad(set_to_none=True)
        losses["total"].backward()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimiser.step()
        _follow(average, model, min(recipe.decay, (step + 1) / (step + 10)))
        if (step + 1) % every == 0 or step + 1 == recipe.steps:
            row = {"step": step + 1, "seconds": round(spent + time.monotonic() - started, 1)}
            row |= {k: round(float(v.detach()), 6) for k, v in losses.items()}
            if validate is not None:
                row |= _validate(model, average, validate)
            curve.append(row)
            log.write_text("".join(json.dumps(r) + "\n" for r in curve))
            about = {"run": run, "steps": str(recipe.steps)}
            write_tensors(_snapshot(step + 1, model, average, optimiser, parameters), checkpoint, about)
    model.load_state_dict(average)
    return {"steps": recipe.steps, "seconds": curve[-1]["seconds"] if curve else 0.0, "curve": curve}


def _run(recipe: Recipe, seed: int, key: str) -> str:
    plain = {k: v for k, v in asdict(recipe).items() if k != "steps"}
    return hashlib.sha256(json.dumps([plain, seed, key]).encode()).hexdigest()


def _read(checkpoint: Path, run: str, steps: int) -> dict[str, Tensor]:
    try:
        with safe_open(str(checkpoint), "pt") as file:
            about = file.metadata() or {}
        tensors = load_file(str(checkpoint))
    except SafetensorError as error:
        raise ValueError(f"{checkpoint} is damaged ({error}): delete it, training then begins again") from None
    if about.get("run") != run or int(about["steps"]) > steps:
        other = f"one of {about['steps']} steps, more than {steps}" if about.get("run") == run else "of other settings"
        raise ValueError(f"{checkpoint} belongs to another run, {other}: delete it or give --work another folder")
    return tensors


def _follow(average: dict[str, Tensor], model: nn.Module, decay: float) -> None:
    for key, value in model.state_dict().items():
        if value.is_floating_point() and "quantizer" not in key:  # the codebook is a moving average already
            average[key].lerp_(value, 1 - decay)
        else:
            average[key].copy_(value)


def _validate(
    model: nn.Module, average: dict[str, Tensor], validate: Callable[[], dict[str, float]]
) -> dict[str, float]:
    current = {k: v.clone() for k, v in model.state_dict().items()}
    model.load_state_dict(average)
    model.eval()
    with torch.no_grad():
        figures = {k: round(float(v), 6) for k, v in validate().items()}
    model.load_state_dict(current)
    model.train()
    return figures


def _snapshot(step: int, model, average, optimiser, parameters) -> dict[str, Tensor]:
    tensors = {"step": torch.tensor(step)}
    tensors |= {f"model.{k}": v.clone() for k, v in model.state_dict().items()}
    tensors |= {f"average.{k}": v.clone() for k, v in average.items()}
    for i, parameter in enumerate(parameters):
        tensors |= {f"adam.{i}.{k}": torch.as_tensor(v).clone() for k, v in optimiser.state[parameter].items()}
    return {k: v.contiguous() for k, v in tensors.items()}


def _restore(tensors: dict[str, Tensor], model, average, optimiser, parameters) -> int:
    model.load_state_dict({k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")})
    for key, value in average.items():
        value.copy_(tensors[f"average.{key}"])
    for i, parameter in enumerate(parameters):
        keys = ("step", "exp_avg", "exp_avg_sq")
        if f"adam.{i}.step" in tensors:  # a parameter that never had a gradient has no state
            optimiser.state[parameter] = {k: tensors[f"adam.{i}.{k}"].clone() for k in keys}
    return int(tensors["step"])
