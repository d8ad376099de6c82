"""Is our denoiser slow, or are denoisers? diffusers' U-Net of nearly the same size, on latents of the same shape.

And how fast does a branch train: steps a second of the shipped recipe on the shipped training scenes.
"""

import importlib.util
import tempfile
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ..conditioning import CHANNELS
from ..data import SAMPLES
from ..pipeline import Ditr
from ..training import recipes
from ..training.batches import load_scenes
from ..unet import count_flops
from .latency import median_ms

NARROWER = 0.625  # the library puts more layers on a level: at this width it has as many parameters as ours


def parameters(net: nn.Module) -> int:
    """Return the number of parameters."""
    return sum(p.numel() for p in net.parameters())


def library_unet(channels_in: int, channels_out: int, width: int, levels: int, heads_at: int) -> nn.Module:
    """Return diffusers' ``UNet2DModel``: as many levels as asked for, attention from ``heads_at`` on.

    Raises:
        ImportError: without diffusers.
    """
    if importlib.util.find_spec("diffusers") is None:
        raise ImportError("the yardstick needs diffusers: pip install -e '.[dev]'")
    from diffusers import UNet2DModel

    down = ["AttnDownBlock2D" if k >= heads_at else "DownBlock2D" for k in range(levels)]
    up = [kind.replace("Down", "Up") for kind in reversed(down)]
    return UNet2DModel(
        in_channels=channels_in,
        out_channels=channels_out,
        block_out_channels=[width * 2**k for k in range(levels)],
        down_block_types=down,
        up_block_types=up,
        layers_per_block=1,
        norm_num_groups=4,
        attention_head_dim=width,
    ).eval()


@torch.no_grad()
def compare_unets(ditr: Ditr, runs: int = 7) -> dict[str, dict[str, float]]:
    """Time one denoising step of our optical branch beside diffusers' U-Net on the same latents.

    Returns:
        "ours" and "diffusers", each with ``parameters``, ``gflops``, ``ms`` and ``ms_per_gflop``. Ours
        includes the extractor of image features, which runs once a frame and whose time is not counted here.

    Raises:
        ImportError: without diffusers.
    """
    config, net = ditr.config, ditr.parts["optical"]
    height, width = (n // 4 for n in config.size)
    latent = config.autoencoder.latent_channels
    x, t = torch.randn(1, latent, height, width), torch.tensor([config.schedule.timesteps - 1])
    image, known = torch.randn(1, len(CHANNELS), *config.size), torch.ones(1, 1, height, width)
    features = net.features(image)
    channels = latent + latent + 1 + config.unet.cond_channels  # what ours concatenates at its entrance, too
    levels, first = len(config.unet.multipliers), min(config.unet.attention_levels)
    width_there = 4 * round(NARROWER * config.unet.width / 4)
    other = library_unet(channels, latent, width_there, levels, first)
    other = other.to(memory_format=torch.channels_last)
    wide = torch.randn(1, channels, height, width).contiguous(memory_format=torch.channels_last)
    calls = {"ours": (net, lambda: net(x, t, features, x, known)), "diffusers": (other, lambda: other(wide, t))}
    rows = {}
    for name, (network, call) in calls.items():
        gflops, ms = count_flops(call) / 1e9, median_ms(call, runs)
        rows[name] = {"parameters": parameters(network), "gflops": gflops, "ms": ms, "ms_per_gflop": ms / gflops}
    return rows


def throughput(ditr: Ditr, steps: int = 3, data: Path | str = SAMPLES / "train") -> dict[str, Any]:
    """Time training steps (forward, backward, update) of the optical branch with the recipe's batch.

    Args:
        ditr: whose configuration and autoencoder are used; its networks are not changed.
        steps: timed, after one that is thrown away; their median counts.
        data: folder of rendered scenes.
    """
    recipe, config = recipes.RECIPES["optical"], ditr.config
    with tempfile.TemporaryDirectory() as folder:  # the shipped samples stay as they are
        scenes = load_scenes(data, boundary="classical", cache=Path(folder) / "maps.npz")
    net = type(ditr.parts["optical"])(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
    net = net.to(memory_format=torch.channels_last)
    loss = recipes.branch_step("optical", net, ditr.parts["autoencoder"], scenes, config, recipe)
    optimiser, count = torch.optim.AdamW(net.parameters(), lr=recipe.lr), iter(range(steps + 1))

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        loss(next(count))["total"].backward()
        optimiser.step()

    seconds = median_ms(step, steps) / 1000
    return {
        "part": "optical",
        "batch": recipe.batch,
        "steps_per_s": 1 / seconds,
        "frames_per_s": recipe.batch / seconds,
    }


def format_unets(rows: dict[str, dict[str, float]]) -> str:
    """Return :func:`compare_unets`' rows as a text table."""
    lines = ["U-Net".ljust(12) + "parameters".rjust(12) + "GFLOPs".rjust(9) + "ms".rjust(9) + "ms/GFLOP".rjust(10)]
    for name, row in rows.items():
        figures = f"{row['parameters']:12,}{row['gflops']:9.2f}{row['ms']:9.1f}{row['ms_per_gflop']:10.1f}"
        lines.append(name.ljust(12) + figures)
    return "\n".join(lines)
