"""What a training costs, before it starts: parameters, operations of a step, memory, hours; and a model of its time.

Paper: Sec. V-B names batches and epochs and no time. Counted is on torch's meta device, forwards and backwards, so
that nothing is allocated: a multiply-add is 2 operations, as in ``costs``. Memory is weights, gradients, moments and
average, and all that autograd keeps until the backward pass; a library's own workspace comes on top.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor, nn
from torch.autograd.graph import saved_tensors_hooks
from torch.nn import functional as F
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from ..conditioning import CHANNELS
from ..config import Config
from ..detail import detail_input
from ..pipeline import build
from ..stage_two import colour_features
from ..training.loop import WHOLE, Recipe, optimiser_of
from ..training.parts import assemble
from ..training.recipes import CROP, freeze_early
from ..training.scenes import Pool, Scenes
from ..unet import STRIDE

FLOAT = 4  # bytes
REACHED = 1 / 3  # of its peak rate that a GPU reaches in training, by what others report: an assumption
HARDWARE = {"RTX 3090, float32": 35.6e12, "A100, bfloat16": 312e12}  # peak operations a second


@dataclass(frozen=True)
class StepCost:
    """What one step of a part costs.

    Attributes:
        parameters: that are trained.
        frozen: parameters that are not, its own and of the networks that it builds on.
        flops: operations of a step, forwards and backwards, of the whole batch.
        activations: bytes that a frame keeps for the backward pass.
        memory: bytes in all, of one process with ``frames`` at a time.
        frames: that a process takes at a time.
    """

    parameters: int
    frozen: int
    flops: int
    activations: int
    memory: int
    frames: int

    def hours(self, steps: int, rate: float) -> float:
        """Return the hours of so many steps at ``rate`` operations a second."""
        return steps * self.flops / rate / 3600


def step_cost(part: str, config: Config, recipe: Recipe, shares: int = 1) -> StepCost:
    """Count a training step of one part.

    Args:
        part: "autoencoder", "region", "optical", "geometric" or "detail".
        config: sizes.
        recipe: its batch and optimiser.
        shares: into which a batch is divided, over processes and accumulation.

    Raises:
        ValueError: for a part that the configuration does not have.
    """
    with torch.device("meta"):
        parts = build(config)
    if part not in parts or part == "encoder":
        raise ValueError(f"no part {part!r} of the {config.name} preset is trained; choose one of {', '.join(parts)}")
    model = parts[part]
    parts["autoencoder"].quantizer.eval()  # moving the codebook is not differentiated, and costs little
    for name, other in parts.items():
        other.requires_grad_(name == part)
    if part == "region":
        freeze_early(model)  # as its recipe does
    with torch.device("meta"):
        given = _given(part, config)
        flops, kept = count_training(lambda: _run(part, parts, given), model)
    used = {"region": (), "autoencoder": ()}.get(part, ("autoencoder", "encoder"))
    used = (*used, "optical", "geometric") if part == "detail" else used
    trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
    frozen = _count(model) - trained + sum(_count(parts[name]) for name in used if name in parts)
    copies = 5 if recipe.optimiser == "adam" else 4  # weights, gradients, average, two moments or one
    frames = -(-recipe.batch // shares)
    memory = FLOAT * (copies * trained + frozen) + frames * kept
    return StepCost(trained, frozen, recipe.batch * flops, kept, memory, frames)


def count_training(fn: Callable[[], Sequence[Tensor]], model: nn.Module) -> tuple[int, int]:
    """Run ``fn`` forwards and backwards, and count.

    Args:
        fn: gives the outputs whose sum is differentiated.
        model: whose weights are not counted as kept.

    Returns:
        operations, and bytes that autograd keeps between the two passes, each storage once.
    """
    weights = {p.untyped_storage()._cdata for p in model.parameters()}
    kept: dict[int, tuple[int, Tensor]] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in weights:
            kept[storage._cdata] = (storage.nbytes(), tensor)  # held, so that no other takes its place
        return tensor

    # the counter does not know fused attention: take the one that is written as matrix products
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        with saved_tensors_hooks(pack, lambda tensor: tensor):
            total = sum(output.float().sum() for output in fn())
        held = sum(size for size, _ in kept.values())
        total.backward()
    return counter.get_total_flops(), held


def _given(part: str, config: Config) -> tuple[Tensor, Tensor]:
    """Return a picture (1, 3, H, W) and a depth map (1, 1, H, W) of the size that a part sees in training."""
    height, width = config.look() if part == "region" else config.size
    if part == "optical" and config.window:
        height = width = config.window
    if part == "autoencoder":
        height = width = min(CROP, height, width)
    return torch.zeros(1, 3, height, width), torch.zeros(1, 1, height, width)


def _run(part: str, parts: nn.ModuleDict, given: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Return what a part's score looks at."""
    rgb, one = given
    if part == "region":
        out = parts["region"](rgb, one, one)
        return [out["logits"], out["boundary"], *out["side"]]
    if part == "autoencoder":
        out = parts["autoencoder"](one)
        return [out["reconstruction"], out["commitment"]]
    if part == "detail":
        with torch.no_grad():
            decoded = parts["autoencoder"].decode(_denoised("optical", parts, rgb, one))
        return [parts["detail"](detail_input(decoded, one, one, one, rgb, one))]
    return [_denoised(part, parts, rgb, one)]


def _denoised(branch: str, parts: nn.ModuleDict, rgb: Tensor, one: Tensor) -> Tensor:
    """Return what a denoiser makes of a view, with all that it is given: two encodings and a picture's features."""
    net = parts[branch]
    with torch.no_grad():
        latents = parts["autoencoder"].encode(one)
        parts["autoencoder"].encode(one)
        colour = colour_features(parts["encoder"] if "encoder" in parts else None, rgb)
    image = torch.zeros(1, len(CHANNELS), *one.shape[2:])
    known = torch.zeros(1, 1, one.shape[2] // STRIDE, one.shape[3] // STRIDE)
    steps = torch.zeros(1, dtype=torch.long)
    return net(latents, steps, net.features(image, colour), latents, known)


def _count(model: nn.Module) -> int:
    return sum(p.numel() for p in model.parameters())


def conv_rate() -> float:
    """Return how many operations a second this machine does now, in a convolution forwards and backwards."""
    net = nn.Conv2d(32, 32, 3, padding=1).to(memory_format=torch.channels_last)
    x = torch.randn(4, 32, 48, 64).contiguous(memory_format=torch.channels_last)
    flops = count_training(lambda: [net(x)], net)[0]
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        F.relu(net(x)).sum().backward()
        seconds.append(time.perf_counter() - start)
    return flops / min(seconds)


def format_cost(part: str, config: Config, recipe: Recipe, shares: int = 1, rate: float | None = None) -> str:
    """Return the arithmetic of a training as text.

    Args:
        part: that is trained.
        config: sizes.
        recipe: how.
        shares: into which a batch is divided.
        rate: operations a second of this machine; None leaves its hours out.
    """
    cost = step_cost(part, config, recipe, shares)
    height, width = _given(part, config)[1].shape[2:]
    each, steps = cost.flops / recipe.batch / 1e9, recipe.steps
    total = steps * cost.flops
    lines = [
        f"{part} of the {config.name} preset, {steps:,} steps of {recipe.batch} views of {width} x {height}",
        f"  parameters   {cost.parameters:,} trained, {cost.frozen:,} frozen",
        f"  operations   {each:,.1f} GFLOP a view x {recipe.batch} x {steps:,} steps = {total:.2e}",
        f"  memory       {cost.memory / 1e9:,.2f} GB: {cost.frames} views at a time keep "
        f"{cost.activations / 1e9:,.3f} GB each",
    ]
    places = {f"{name}, {REACHED:.0%} of its peak": REACHED * peak for name, peak in HARDWARE.items()}
    if rate is not None:
        places = {f"here, at {rate / 1e9:,.0f} GFLOP/s": rate} | places
    lines += [f"  hours        {cost.hours(steps, r):,.2f} ({name})" for name, r in places.items()]
    return "\n".join(lines)


# --- a model of the time ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TimeModel:
    """Seconds of a step: ``fixed`` + ``per_gflop`` x GFLOP + ``per_gb`` x GB that autograd keeps."""

    fixed: float
    per_gflop: float
    per_gb: float

    def seconds(self, gflop: float, gb: float) -> float:
        """Return the seconds of a step."""
        return self.fixed + self.per_gflop * gflop + self.per_gb * gb


def fit_time(gflop: Sequence[float], gb: Sequence[float], seconds: Sequence[float]) -> TimeModel:
    """Fit a :class:`TimeModel` to measured steps: least squares of the relative errors, no coefficient below 0.

    Raises:
        ValueError: for fewer than 3 measurements, or times that are not positive.
    """
    columns = np.stack([np.ones(len(gflop)), np.asarray(gflop, float), np.asarray(gb, float)], axis=1)
    measured = np.asarray(seconds, float)
    if len(measured) < 3 or not (measured > 0).all() or len(measured) != len(columns):
        raise ValueError(f"expected at least 3 measured steps with times above 0, got {list(seconds)}")
    return TimeModel(*nnls(columns / measured[:, None], np.ones(len(measured)))[0])


def measure_step(part: str, config: Config, scenes: Scenes, batch: int, runs: int = 3) -> tuple[float, float, float]:
    """Time training steps of a part, new, on one drawn batch, without drawing it.

    Returns:
        GFLOP of a step, GB that autograd keeps for it, and seconds of processor time.
    """
    recipe = Recipe(steps=1, batch=batch, lr=1e-3)
    cost = step_cost(part, config, recipe)
    parts = build(config)
    for name, other in parts.items():
        other.requires_grad_(name == part)
    step, _ = assemble(part, parts, Pool([scenes]), None, config, recipe, "none", 0)
    drawn = step.draw(0, WHOLE)
    model = parts[part].to(memory_format=torch.channels_last).train()
    optimiser = optimiser_of(recipe, list(model.parameters()))

    def once() -> None:
        optimiser.zero_grad(set_to_none=True)
        step.score(drawn, 0, WHOLE)["total"].backward()
        optimiser.step()

    return cost.flops / 1e9, batch * cost.activations / 1e9, step_seconds(once, runs)


def step_seconds(fn: Callable[[], object], runs: int = 5) -> float:
    """Return the least processor time of a call: a busy machine slows it, nothing speeds it up."""
    fn()
    took = []
    for _ in range(runs):
        start = time.process_time()
        fn()
        took.append(time.process_time() - start)
    return min(took)
