"""The training loop: every network here is trained by :func:`fit`, on one CPU core or on many GPUs.

``accelerate`` says where it runs: alone as ``python -m ditr_lite train``, in several processes as ``torchrun
--nproc-per-node N -m ditr_lite train`` or ``accelerate launch``. A batch is divided into equal *shares*, one for each
process and each turn of accumulation. All draw the same whole batch from (seed, step) and keep their share of it, so
that the gradient, the mean over all shares, is that of the whole batch: how many processes there are changes the speed
and the rounding, and nothing else. Exactly so where a loss is a mean over frames (denoisers) or over equally many
pixels (boundaries). Stage one, the autoencoder and the finer final step take means over the pixels that are known or
claimed, and then the mean over shares weighs these a little differently; the autoencoder's codebook follows the first
process's share.
"""

import hashlib
import json
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset
from tqdm.auto import tqdm

from . import checkpoints

if TYPE_CHECKING:
    from accelerate import Accelerator, PartialState

OPTIMISERS = {"adam": torch.optim.AdamW, "sgd": torch.optim.SGD}
PRECISIONS = ("auto", "no", "bf16")
ADDED = ("optimiser", "momentum", "clip", "ramp", "patience", "law", "epoch")  # to recipes, since checkpoints exist
EVERY = 500  # steps between validations, each with a checkpoint
ROUNDS = 7  # in which steps are timed
FALL = math.log(10)  # our exponential factor of the paper's rate ends at a tenth
Losses = dict[str, Tensor]


@dataclass(frozen=True)
class Recipe:
    """How long and how fast one part trains.

    Attributes:
        steps: of the optimiser.
        batch: frames a step, over all processes.
        lr: peak learning rate.
        warmup: steps of a linear rise.
        decay: of the moving average of the weights.
        weight_decay: of the optimiser.
        optimiser: "adam" (AdamW) or "sgd" (the paper's stage one).
        momentum: of SGD.
        clip: largest norm of the gradient; 0 sets no limit.
        ramp: whether the average begins short and grows to ``decay``; without, it begins with the weights at the start.
        patience: validations without a better figure after which training stops; 0 never stops early.
        law: of the rate, one of :data:`LAWS`.
        epoch: steps of an epoch, for laws that count them.

    Raises:
        ValueError: for no step, no frame, a negative or infinite rate, or an unknown optimiser or law.
    """

    steps: int
    batch: int
    lr: float
    warmup: int = 100
    decay: float = 0.995
    weight_decay: float = 1e-4
    optimiser: str = "adam"
    momentum: float = 0.0
    clip: float = 1.0
    ramp: bool = True
    patience: int = 0
    law: str = "cosine"
    epoch: int = 1

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 1 or self.epoch < 1:
            raise ValueError(f"expected at least 1 step and 1 frame a step, got {self.steps} steps, batch {self.batch}")
        if not 0 <= self.lr < float("inf"):  # at 0 only running statistics move; NaN fails too
            raise ValueError(f"expected a finite learning rate of at least 0, got {self.lr}")
        if self.optimiser not in OPTIMISERS or self.law not in LAWS:
            known = f"{', '.join(OPTIMISERS)} and a law of {', '.join(LAWS)}"
            raise ValueError(f"expected an optimiser of {known}, got {self.optimiser!r} and {self.law!r}")


def cosine(step: int, recipe: Recipe) -> float:
    """Return the rate at a step: linear warm-up, then half a cosine down to a hundredth."""
    if step < recipe.warmup:
        return recipe.lr * (step + 1) / recipe.warmup
    progress = (step - recipe.warmup) / max(1, recipe.steps - recipe.warmup)
    return recipe.lr * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * progress)))


def constant(step: int, recipe: Recipe) -> float:
    """Return the same rate at every step, after a linear warm-up."""
    return recipe.lr * min(1.0, (step + 1) / max(1, recipe.warmup))


def falling(step: int, recipe: Recipe) -> float:
    """Return the rate of an epoch: half a cosine times an exponential that ends at a tenth (Paper: Sec. V-B)."""
    epochs = math.ceil(recipe.steps / recipe.epoch)  # the last may be cut short
    return recipe.lr * fall_by((step // recipe.epoch) / epochs)


def fall_by(p: float, fall: float = FALL) -> float:
    """Return half a cosine times an exponential, 1 at p = 0 and 0 at p = 1; see ``as_the_paper``."""
    return (1 + math.cos(math.pi * p)) / 2 * math.exp(-fall * p)


LAWS: dict[str, Callable[[int, Recipe], float]] = {"cosine": cosine, "constant": constant, "falling": falling}


def learning_rate(step: int, recipe: Recipe) -> float:
    """Return the rate at a step, by the recipe's law."""
    return LAWS[recipe.law](step, recipe)


# --- what is done in a step, and by whom ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Share:
    """Part ``index`` of ``of`` equal parts of a batch."""

    index: int = 0
    of: int = 1

    def take(self, items: Sequence[Any]) -> Any:
        """Return this share of a list or of a tensor's first axis.

        Raises:
            ValueError: when it cannot be divided.
        """
        if len(items) % self.of:
            raise ValueError(f"a batch of {len(items)} cannot be divided into {self.of} equal shares: change --batch")
        size = len(items) // self.of
        return items[self.index * size : (self.index + 1) * size]


WHOLE = Share()


@dataclass(frozen=True)
class Step:
    """One training step in two halves.

    Attributes:
        draw: step, share -> tensors; NumPy's random numbers and the pictures, on the CPU, in workers where there are.
        score: these, step, share -> losses, of which ``total`` is minimised; torch's random numbers and the networks.
        frozen: networks that ``score`` uses besides the one that is trained.
    """

    draw: Callable[[int, Share], Any]
    score: Callable[[Any, int, Share], Losses]
    frozen: tuple[nn.Module, ...] = ()

    def __call__(self, step: int, share: Share = WHOLE) -> Losses:
        """Do both halves here and now."""
        return self.score(self.draw(step, share), step, share)


@dataclass(frozen=True)
class Engine:
    """On what and how a training runs. Nothing of it belongs to the recipe: what is learnt is the same up to rounding.

    Attributes:
        accumulate: shares of a batch that a process takes in turn, for less memory.
        workers: processes that prepare batches beside each training process; 0 prepares them in turn.
        precision: "no" is float32, "bf16" computes in bfloat16 and keeps the weights in float32, "auto" does that where
            the GPU has it.
        cpu: use no GPU.

    Raises:
        ValueError: for numbers below 1 (0 workers are allowed), or an unknown precision.
    """

    accumulate: int = 1
    workers: int = 0
    precision: str = "auto"
    cpu: bool = False

    def __post_init__(self) -> None:
        if self.accumulate < 1 or self.workers < 0:
            raise ValueError(f"expected accumulate >= 1 and workers >= 0, got {self.accumulate} and {self.workers}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"unknown precision {self.precision!r}; choose one of {', '.join(PRECISIONS)}")

    def join(self) -> None:
        """Join the other processes, where there are any; whoever asks first decides whether on CPUs."""
        _place(self.cpu)

    def start(self) -> "Accelerator":
        """Find out how this process was started and join the others, where there are any."""
        from accelerate import Accelerator  # here: it takes a third of a second, and most who import this never train

        self.join()
        return Accelerator(cpu=self.cpu, mixed_precision="no")  # Scored does that, where `half` says so

    def shares(self, accelerator: "Accelerator", batch: int) -> list[Share]:
        """Return what this process takes of every batch, in turn.

        Raises:
            ValueError: when the batch cannot be divided.
        """
        count = accelerator.num_processes * self.accumulate
        if batch % count:
            there = f"{accelerator.num_processes} processes x {self.accumulate} turns"
            raise ValueError(f"a batch of {batch} cannot be divided into equal shares of {there}: change --batch")
        first = accelerator.process_index * self.accumulate
        return [Share(first + k, count) for k in range(self.accumulate)]

    def half(self, accelerator: "Accelerator") -> bool:
        """Return whether to compute in bfloat16."""
        if self.precision == "auto":
            has_it = accelerator.device.type == "cuda" and torch.cuda.is_bf16_supported()
            return has_it or os.environ.get("ACCELERATE_MIXED_PRECISION") == "bf16"  # asked of accelerate's launcher
        return self.precision == "bf16"


ENGINE = Engine()


class Scored(nn.Module):
    """A model with its score as ``forward``: what ``accelerate`` wraps, so that every process's gradients are joined.

    Joining them hangs on ``forward``; a score may call the model in other ways and more than once.
    """

    def __init__(self, model: nn.Module, step: Step, half: bool):
        super().__init__()
        self.model, self.step, self.half = model, step, half

    def forward(self, drawn: Any, k: int, share: Share) -> Losses:
        """Return the losses of a share of step ``k``."""
        device = next(self.model.parameters()).device.type
        with torch.autocast(device, torch.bfloat16) if self.half else nullcontext():
            return self.step.score(drawn, k, share)


class Draws(Dataset):
    """Step k -> the drawn shares of this process; sent to workers as it is."""

    def __init__(self, step: Step, shares: Sequence[Share]):
        self.draw, self.shares = step.draw, shares

    def __getitem__(self, k: int) -> list[Any]:
        """Draw all shares of a step."""
        return [self.draw(k, share) for share in self.shares]


def drawn_shares(step: Step, shares: Sequence[Share], steps: range, workers: int) -> Iterator[list[Any]]:
    """Return the drawn shares of every step, in order, whoever prepares them."""
    how = {"num_workers": workers, "worker_init_fn": _alone} if workers else {}
    return iter(DataLoader(Draws(step, shares), batch_size=None, sampler=steps, collate_fn=_as_it_is, **how))


def _alone(worker: int) -> None:
    cv2.setNumThreads(0)  # its threads do not survive a fork


def _as_it_is(drawn: Any) -> Any:
    return drawn


# --- the loop ---------------------------------------------------------------------------------------------------------


def fit(
    name: str,
    model: nn.Module,
    step_loss: Step | Callable[[int], Losses],
    recipe: Recipe,
    folder: Path | str | None,
    validate: Callable[[], dict[str, float]] | None = None,
    every: int = EVERY,
    seed: int = 0,
    progress: bool = True,
    key: str = "",
    engine: Engine = ENGINE,
    watch: Callable[[int, dict[str, float]], None] | None = None,
    best: str | None = None,
    rate: Callable[[int, Recipe], float] = learning_rate,
) -> dict[str, Any]:
    """Train ``model`` in place and leave it with its moving-average weights.

    A checkpoint (weights, average, optimiser, curve) is written to ``folder`` every ``every`` steps; a later call with
    the same arguments goes on from it. Step k draws the same numbers whether or not training was interrupted before
    it. Only ``recipe.steps`` may be larger than before: what is left is then done at the rates of the longer run.

    Args:
        name: of the part; names the files.
        model: trained in place.
        step_loss: a :class:`Step`, or step -> losses, of which ``total`` is minimised, for one process.
        recipe: steps, batch and rate.
        folder: for checkpoints and the log ``name.jsonl``; None writes neither.
        validate: returns figures to log, taken with the averaged weights, by the first process alone.
        every: steps between checkpoints.
        seed: of torch's generator.
        progress: show a bar.
        key: of all that decides the weights besides recipe and seed, such as scenes and the weights at the start; a
            checkpoint with another key is not taken.
        engine: on what and how it runs.
        watch: called with every step and its losses, in the first process.
        best: a figure of ``validate`` that should be small: the averaged weights with the smallest are what remains,
            those at the start among them, and training stops after ``recipe.patience`` validations without a smaller.
        rate: step, recipe -> learning rate, for laws that have no name; tell ``key`` which.

    Returns:
        ``steps`` that the recipe has, ``seconds`` of wall time, and the ``curve`` of logged figures.

    Raises:
        ValueError: for a checkpoint of another run or of a model of other sizes, or a damaged one; a loss or gradient
            that is not finite; a batch that cannot be divided among the processes.
    """
    step = step_loss if isinstance(step_loss, Step) else Step(_number, lambda k, *_: step_loss(k))
    run = Run(name, model, step, recipe, folder, seed, key, engine, best)
    state, accelerator, scored = run.state, run.accelerator, run.scored
    started = time.monotonic() - (state.curve[-1]["seconds"] if state.curve else 0.0)
    if best and not state.curve:
        state.curve.append({"step": 0, "seconds": 0.0} | run.validate(validate))
        run.keep_best()
    left = range(state.step, state.step if run.is_over() else recipe.steps)
    drawn = drawn_shares(step, run.shares, left, engine.workers)
    bar = {} if progress and accelerator.is_main_process else {"disable": True}  # left to tqdm's own default otherwise
    model.train()
    for k in tqdm(left, name, recipe.steps, initial=state.step, unit="step", **bar):
        for group in state.optimiser.param_groups:
            group["lr"] = rate(k, recipe)
        state.optimiser.zero_grad(set_to_none=True)
        losses = []
        for share, data in zip(run.shares, next(drawn), strict=True):
            torch.manual_seed((seed * 1_000_003 + k) % 2**63)  # the noise of the whole batch, whoever takes which share
            more = share is not run.shares[-1]
            with accelerator.no_sync(scored) if more else nullcontext():  # gradients are joined once, at the last share
                losses.append(scored(to_device(data, accelerator.device), k, share))
                accelerator.backward(losses[-1]["total"] / len(run.shares))
        norm = nn.utils.clip_grad_norm_(state.parameters, recipe.clip or math.inf)
        run.check_finite(k, losses, norm)
        state.optimiser.step()
        follow_average(state.average, model, min(recipe.decay, (k + 1) / (k + 10)) if recipe.ramp else recipe.decay)
        state.step = k + 1
        logged = state.step % every == 0 or state.step == recipe.steps
        figures = run.mean_of(losses) if logged or watch else {}
        if watch and accelerator.is_main_process:
            watch(k, figures)
        if logged:
            row = {"step": state.step, "seconds": round(time.monotonic() - started, 1)}
            row |= {name: round(value, 6) for name, value in figures.items()}
            state.curve.append(row | run.validate(validate))
            run.keep_best()
            run.save()
            if run.is_over():
                break
    return run.end()


def _number(step: int, share: Share) -> int:
    """Draw nothing but the step's number: all is done where it is scored."""
    if share.of > 1:
        raise ValueError("this step loss is for one process without accumulation: give fit a Step")
    return step


class Run:
    """What surrounds the loop: the state, where it runs, checkpoints, validation, and when to stop."""

    def __init__(
        self,
        name: str,
        model: nn.Module,
        step: Step,
        recipe: Recipe,
        folder: Path | str | None,
        seed: int,
        key: str,
        engine: Engine,
        best: str | None,
    ):
        self.name, self.recipe, self.step, self.best = name, recipe, step, best
        self.accelerator = engine.start()
        self.shares = engine.shares(self.accelerator, recipe.batch)
        self.folder = None if folder is None else Path(folder)
        self.key = run_key(recipe, seed, key)
        device = self.accelerator.device
        for module in (model, *step.frozen):
            module.to(device)
        parameters = [p for p in model.parameters() if p.requires_grad]
        optimiser = optimiser_of(recipe, parameters)
        average = {k: v.clone() for k, v in model.state_dict().items()}
        self.state = checkpoints.State(model, average, optimiser, parameters, recipe.optimiser)
        self.resume()
        # Nothing to join in one process, so that the model is left as it is
        self.scored = self.accelerator.prepare(Scored(model, step, engine.half(self.accelerator)))

    @property
    def checkpoint(self) -> Path:
        """The file of the checkpoint."""
        return self.folder / f"{self.name}.checkpoint.safetensors"

    @property
    def log(self) -> Path:
        """The file of the curve."""
        return self.folder / f"{self.name}.jsonl"

    def resume(self) -> None:
        """Take up a checkpoint where there is one; every process must see the same."""
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.checkpoint.is_file():
            shares = checkpoints.restore(self.checkpoint, self.log, self.state, self.key, self.recipe.steps)
            if shares != self.shares[0].of:
                told = f"{self.checkpoint} was made with batches in {shares} shares, now {self.shares[0].of}"
                warnings.warn(f"{told}: the same training, but for rounding", stacklevel=4)
        if self.accelerator.num_processes > 1:
            here = torch.tensor([self.state.step], device=self.accelerator.device)
            there = self.accelerator.gather(here).tolist()
            if len(set(there)) > 1:
                told = ", ".join(map(str, there))
                raise ValueError(f"the processes found checkpoints of steps {told}: give all the same --work folder")

    def check_finite(self, k: int, losses: Sequence[Losses], norm: Tensor) -> None:
        """Stop, before the weights are moved, where a loss or the gradient is not finite in any process."""
        totals = torch.stack([x["total"].detach().float() for x in losses])
        wrong = ~(torch.isfinite(totals).all() & torch.isfinite(norm))
        if self.accelerator.num_processes > 1:
            wrong = self.accelerator.reduce(wrong.float()[None], "sum")[0] > 0
        if not wrong:
            return
        last = "there is no checkpoint yet"
        if self.folder is not None and self.checkpoint.is_file():
            last = f"the last good checkpoint, of step {self.state.curve[-1]['step']}, is {self.checkpoint}"
        what = f"loss {float(totals.mean())}, norm of the gradient {float(norm)}"
        raise ValueError(
            f"training of {self.name} stopped at step {k + 1}: it is not finite any more ({what}); {last}. Lower --lr, "
            "or look at the data of that step; a new rate needs another --work folder"
        )

    def mean_of(self, losses: Sequence[Losses]) -> dict[str, float]:
        """Return the mean of each loss over shares and processes."""
        names = list(losses[0])
        rows = torch.stack([torch.stack([x[name].detach().float() for name in names]) for x in losses])
        mean = rows[0] if len(losses) == 1 else rows.mean(0)
        if self.accelerator.num_processes > 1:
            mean = self.accelerator.reduce(mean, "mean")
        return dict(zip(names, mean.tolist(), strict=True))

    def validate(self, validate: Callable[[], dict[str, float]] | None) -> dict[str, float]:
        """Return the figures of the averaged weights; in the first process, which tells the others the watched one."""
        figures = {}
        if validate is not None and self.accelerator.is_main_process:
            figures = _with_average(self.state.model, self.state.average, validate)
        if self.best is not None and self.accelerator.num_processes > 1:
            told = torch.tensor([figures.get(self.best, 0.0)], device=self.accelerator.device, dtype=torch.float64)
            figures[self.best] = float(self.accelerator.reduce(told, "sum")[0])
        return figures

    def keep_best(self) -> None:
        """Keep the average where the watched figure is the smallest so far."""
        curve = self.state.curve
        if self.best and best_row(curve, self.best) is curve[-1]:
            self.state.best = {k: v.clone() for k, v in self.state.average.items()}

    def is_over(self) -> bool:
        """Return whether the watched figure has not become smaller for as many validations as the recipe waits."""
        curve, patience = self.state.curve, self.recipe.patience
        if not self.best or not patience:
            return False
        return len(curve) - 1 - curve.index(best_row(curve, self.best)) >= patience

    def save(self) -> None:
        """Write log and checkpoint, in the first process; the others wait."""
        if self.folder is not None and self.accelerator.is_main_process:
            checkpoints.write_log(self.log, self.state.curve)
            checkpoints.write_checkpoint(self.checkpoint, self.state, self.key, self.recipe.steps, self.shares[0].of)
        self.accelerator.wait_for_everyone()

    def end(self) -> dict[str, Any]:
        """Leave the model on the CPU with the weights that remain, and return the notes."""
        state = self.state
        state.model.load_state_dict(state.best or state.average)
        for module in (state.model, *self.step.frozen):
            module.to("cpu")
        notes = {"steps": self.recipe.steps, "seconds": state.curve[-1]["seconds"] if state.curve else 0.0}
        if self.best:
            notes |= {"steps": state.step, "best_step": best_row(state.curve, self.best)["step"]}
        if self.shares[0].of > 1:
            notes["shares"] = self.shares[0].of
        return notes | {"curve": state.curve}


def optimiser_of(recipe: Recipe, parameters: Sequence[nn.Parameter]) -> torch.optim.Optimizer:
    """Return the recipe's optimiser; the rate is set before every step."""
    momentum = {"momentum": recipe.momentum} if recipe.optimiser == "sgd" else {}
    return OPTIMISERS[recipe.optimiser](parameters, lr=recipe.lr, weight_decay=recipe.weight_decay, **momentum)


def best_row(curve: Sequence[dict[str, Any]], name: str) -> dict[str, Any]:
    """Return the first row with the smallest figure; one that is not a number counts as the largest."""
    return min(curve, key=lambda row: row[name] if row[name] == row[name] else math.inf)


def run_key(recipe: Recipe, seed: int, key: str) -> str:
    """Return the checksum of all that decides the weights, but for the number of steps."""
    default = {f.name: f.default for f in fields(Recipe)}
    values = {k: v for k, v in asdict(recipe).items() if k not in ADDED or v != default[k]}
    del values["steps"]
    return hashlib.sha256(json.dumps([values, seed, key]).encode()).hexdigest()


def to_device(drawn: Any, device: torch.device) -> Any:
    """Return tensors, what has a ``to``, and lists and dictionaries of these, on a device."""
    if isinstance(drawn, dict):
        return {k: to_device(v, device) for k, v in drawn.items()}
    if isinstance(drawn, list | tuple):
        return type(drawn)(to_device(v, device) for v in drawn)
    return drawn.to(device) if hasattr(drawn, "to") else drawn


@torch.no_grad()
def follow_average(average: dict[str, Tensor], model: nn.Module, decay: float) -> None:
    """Move the average towards the model's tensors; counters and the codebook, an average already, are copied."""
    for key, value in model.state_dict().items():
        if value.is_floating_point() and "quantizer" not in key:
            average[key].lerp_(value, 1 - decay)
        else:
            average[key].copy_(value)


def time_steps(
    nets: Mapping[str, nn.Module], steps: Mapping[str, Callable[[int], Losses]], rounds: int = ROUNDS
) -> dict[str, float]:
    """Return name -> seconds of processor time that a training step takes here; the weights stay as they are.

    It does all that a step of :func:`fit` does, all networks in turn, so that a slow moment of the machine falls on all
    alike.

    Args:
        nets: name -> network.
        steps: name -> its step loss.
        rounds: over all networks; the median counts.
    """
    optimisers = {name: torch.optim.AdamW(net.parameters(), lr=0.0) for name, net in nets.items()}
    averages = {name: {k: v.clone() for k, v in net.state_dict().items()} for name, net in nets.items()}
    took: dict[str, list[float]] = {name: [] for name in nets}
    for k in range(rounds):
        for name, step in steps.items():
            start = time.process_time()
            optimisers[name].zero_grad(set_to_none=True)
            step(k)["total"].backward()
            nn.utils.clip_grad_norm_(nets[name].parameters(), 1.0)
            optimisers[name].step()
            follow_average(averages[name], nets[name], 0.9)
            took[name].append(time.process_time() - start)
    for optimiser in optimisers.values():
        optimiser.zero_grad(set_to_none=True)
    return {name: sorted(seconds)[rounds // 2] for name, seconds in took.items()}


def _with_average(
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


def is_first() -> bool:
    """Return whether this is the process that writes files: the only one, or the first of several."""
    return _place().is_main_process


def wait_for_all() -> None:
    """Wait until every process is here; do nothing where there is one."""
    _place().wait_for_everyone()


def leave() -> None:
    """Say goodbye to the other processes; do nothing where there are none."""
    if _place().num_processes > 1:
        _place().destroy_process_group()


def _place(cpu: bool = False) -> "PartialState":
    from accelerate import PartialState

    return PartialState(cpu=cpu or not torch.accelerator.is_available())  # unless told, it joins no processes on CPUs
