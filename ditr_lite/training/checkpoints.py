"""Checkpoints: one safetensors file that holds a stopped training, with a checksum over all of it.

No pickle. The file appears whole or not at all. Its metadata holds which run it is of, the curve so far, and a SHA-256
of all tensors and of the rest of the metadata, so that a single flipped bit is noticed.
"""

import hashlib
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from ..files import written_whole
from ..store import write_tensors

EARLIER = {"run", "steps"}  # all that the metadata held before there was a checksum


@dataclass
class State:
    """Everything that a training is: what is written into a checkpoint and read from it.

    Attributes:
        model: with the weights of the last step.
        average: name -> moving average of the model's tensors.
        optimiser: with its moments.
        parameters: that it moves, in its order.
        kind: of the optimiser, which names its tensors in the file.
        step: steps that are done.
        curve: rows of figures, one a logged step.
        best: name -> the averaged tensors that scored best so far; empty where nobody asks.
    """

    model: nn.Module
    average: dict[str, Tensor]
    optimiser: torch.optim.Optimizer
    parameters: list[nn.Parameter]
    kind: str
    step: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)
    best: dict[str, Tensor] = field(default_factory=dict)


def write_checkpoint(path: Path, state: State, run: str, steps: int, shares: int) -> None:
    """Write a checkpoint.

    Args:
        path: of the file.
        state: of the training.
        run: key of all that decides the weights.
        steps: that the recipe has in all.
        shares: into which each batch was divided, over processes and accumulation.
    """
    tensors = {"step": torch.tensor(state.step)}
    tensors |= {f"model.{k}": v for k, v in state.model.state_dict().items()}
    tensors |= {f"average.{k}": v for k, v in state.average.items()}
    tensors |= {f"best.{k}": v for k, v in state.best.items()}
    for i, parameter in enumerate(state.parameters):
        moments = state.optimiser.state[parameter].items()
        tensors |= {f"{state.kind}.{i}.{k}": torch.as_tensor(v) for k, v in moments if v is not None}
    tensors = {k: v.detach().cpu().clone(memory_format=torch.contiguous_format) for k, v in tensors.items()}
    about = {"run": run, "steps": str(steps), "shares": str(shares), "curve": json.dumps(state.curve)}
    write_tensors(tensors, path, about | {"sha256": digest(tensors, about)})


def digest(tensors: Mapping[str, Tensor], about: Mapping[str, str]) -> str:
    """Return the SHA-256 of tensors, by name, kind, shape and bytes, and of what is said about them."""
    found = hashlib.sha256(json.dumps(dict(about), sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy())
    return found.hexdigest()


def read_checkpoint(path: Path, run: str, steps: int) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors of a checkpoint and what it says of itself.

    Raises:
        ValueError: for a damaged file, or one of another run or of more steps.
    """
    try:
        with safe_open(str(path), "pt") as file:
            about = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # of this file, even if it is replaced now
    except (SafetensorError, OSError, UnicodeDecodeError) as error:
        raise _damaged(path, error) from None
    checksum = about.pop("sha256", None)
    if checksum is None and about.keys() <= EARLIER:
        if about.keys() == EARLIER:
            warnings.warn(f"{path} is of an earlier version and has no checksum: damage would not show", stacklevel=2)
    elif checksum != digest(tensors, about):
        raise _damaged(path, "its checksum does not fit")
    if about.get("run") != run or int(about["steps"]) > steps:
        other = f"one of {about['steps']} steps, more than {steps}" if about.get("run") == run else "of other settings"
        raise ValueError(f"{path} belongs to another run, {other}: delete it or give --work another folder")
    return tensors, about


def _damaged(path: Path, why: object) -> ValueError:
    return ValueError(f"{path} is damaged ({why}): delete it, training then begins again")


def restore(path: Path, log: Path, state: State, run: str, steps: int) -> int:
    """Bring ``state`` to where a checkpoint left it.

    Args:
        path: of the checkpoint.
        log: rows of the curve, for a checkpoint of an earlier version that does not hold them.
        state: of the same model, to be overwritten.
        run: key of the run.
        steps: of the recipe.

    Returns:
        into how many shares the batches were divided.

    Raises:
        ValueError: as :func:`read_checkpoint`, and for a checkpoint of other sizes.
    """
    tensors, about = read_checkpoint(path, run, steps)
    try:
        state.model.load_state_dict(_of("model.", tensors))
        for key, value in state.average.items():
            value.copy_(tensors[f"average.{key}"])
        for i, parameter in enumerate(state.parameters):
            if moments := _of(f"{state.kind}.{i}.", tensors):  # a parameter that never had a gradient has none
                state.optimiser.state[parameter] = {k: _beside(v, parameter, k) for k, v in moments.items()}
    except (RuntimeError, KeyError):  # torch's message is a page of tensor names
        raise ValueError(f"{path} is of other sizes: delete it, or use another folder") from None
    state.step = int(tensors["step"])
    state.best = _of("best.", tensors)
    rows = json.loads(about["curve"]) if "curve" in about else _rows(log)
    state.curve = [row for row in rows if row["step"] <= state.step]
    return int(about.get("shares", 1))


def _of(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _beside(value: Tensor, parameter: Tensor, name: str) -> Tensor:
    """Return a moment where its parameter is; the counter of steps stays on the CPU, as the optimisers keep it."""
    return value.clone() if name == "step" else value.to(parameter.device).clone()


def _rows(log: Path) -> list[dict[str, Any]]:
    """Return the rows of a log, without those that cannot be read."""
    rows = []
    for line in log.read_text().splitlines() if log.is_file() else []:
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(row, dict) and "step" in row and "seconds" in row:
            rows.append(row)
    return rows


def write_log(path: Path, curve: list[dict[str, Any]]) -> None:
    """Write the curve as a file of JSON, a line a row, whole or not at all."""
    with written_whole(path) as part:
        part.write_text("".join(json.dumps(row) + "\n" for row in curve))
