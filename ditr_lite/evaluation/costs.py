"""Count what a configuration costs a frame, network by network, without running it.

Paper: Table VI, GFLOPs per stage at 1280 x 720. Its 206 for stage two do not fit what the text describes, 1,000 steps
in two branches and two passes of SAM's ViT-L; ``timing`` measures what a CPU can run, this file counts what it cannot,
the ``paper`` preset among it. A multiply-add counts as 2 operations here; many tools count it as 1 and also call that a
FLOP. The paper does not say which it did, so :func:`beside_table_vi` shows both.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from ..conditioning import CHANNELS
from ..config import Config
from ..detail import detail_input
from ..pipeline import build
from ..stage_two import BRANCHES, colour_features
from ..unet import STRIDE, DenoisingUNet

Row = dict[str, Any]
TABLE_VI = {"one": (43, 16), "two": (2256, 206)}  # the paper's milliseconds and GFLOPs of both stages
RTX_3090_GFLOPS = 35_600  # per second, the peak in float32 of the GPU that the paper used: nothing runs faster
SAM_VIT_L = 308_278_272  # parameters of the image encoder alone


def count_flops(fn: Callable, *inputs, **kwargs) -> int:
    """Count the floating-point operations of ``fn(*inputs)``, a module or any callable, as 2 per multiply-add."""
    # the counter does not know the CPU's fused attention: take the one that is written as matrix products
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        fn(*inputs, **kwargs)
    return counter.get_total_flops()


@torch.no_grad()
def costs(config: Config, sam: bool = False, windows: int = 1) -> list[Row]:
    """Count every network at the working size of ``config``, on torch's meta device: nothing is allocated.

    Args:
        config: the system, sampler included.
        sam: also count the two passes of ViT-L that give the paper's boundary maps (Sec. IV-C, "Feature Extractor").
        windows: in which the optical branch looks; of no meaning where it looks at whole frames.

    Returns:
        One {"stage", "network", "parameters", "gflops", "calls"} for each network, in the order in which they run.
        ``gflops`` is that of one call, ``calls`` how many a frame needs. Where both branches look at whole frames they
        share their rows; otherwise each has its own, and "in windows" stands behind the optical one's. ``parameters``
        leaves out what a row above has counted, so that a column of them adds up to the whole system.
    """
    with torch.device("meta"):
        parts = build(config).eval()
        rows = _stage_one(parts["region"], config)
        if sam:
            gflops = vit_flops() / 1e9
            rows.append({"stage": "two", "network": "SAM ViT-L", "parameters": SAM_VIT_L, "gflops": gflops, "calls": 2})
        if not config.window:
            return rows + _stage_two(parts, config, config.size, BRANCHES, len(BRANCHES))
        rows += _stage_two(parts, config, config.size, ("geometric",), 1)
        close = _stage_two(parts, config, (config.window, config.window), ("optical",), windows, shared=False)
    return rows + [{**row, "network": f"{row['network']}, in windows"} for row in close]


def _stage_one(net: nn.Module, config: Config) -> list[Row]:
    """Count stage one, look by look."""
    rows = []
    for scale in config.refine.looks:
        size = config.look(scale)
        one, rgb = torch.zeros(1, 1, *size), torch.zeros(1, 3, *size)
        name = "region" if scale == 1 else f"region, {scale:g} times as large"
        rows.append(_row("one", name, (scale == config.refine.looks[0]) * _parameters(net), 1, net, rgb, one, one))
    return rows


def _stage_two(
    parts: nn.ModuleDict,
    config: Config,
    size: tuple[int, int],
    branches: tuple[str, ...],
    views: int,
    shared: bool = True,
) -> list[Row]:
    """Count stage two on views of one size.

    Args:
        parts: the networks, on the meta device.
        config: of the system.
        size: (H, W) of a view.
        branches: whose parameters are counted; they are alike.
        views: of a frame, of all these branches together.
        shared: whether to count the parameters of what branches share.
    """
    net, vae = parts[branches[0]], parts["autoencoder"]
    samples, own = config.sampler.samples, len(branches)
    one, rgb = torch.zeros(1, 1, *size), torch.zeros(1, 3, *size)
    latents = torch.zeros(1, config.autoencoder.latent_channels, size[0] // STRIDE, size[1] // STRIDE)
    image = torch.zeros(1, len(CHANNELS), *size)
    rows = [_row("two", "encoder", shared * _parameters(vae.encoder), views, vae.encode, one)]
    colour = []
    if "encoder" in parts:
        look = partial(colour_features, parts["encoder"])
        rows.append(_row("two", "picture encoder", shared * _parameters(parts["encoder"]), views, look, rgb))
        colour = look(rgb)
    features = net.features(image, colour)
    step = (latents, torch.zeros(1, dtype=torch.long), features, latents, latents[:, :1])
    extractor = own * _parameters(net.extractor)
    rest = own * _parameters(net) - extractor
    calls = views * samples * config.sampler.steps
    rows.append(_row("two", "F(x)", extractor, views, net.features, image, colour))
    rows.append(_row("two", "denoiser, one step", rest, calls, net, *step))
    rows.append(_row("two", "decoder", shared * _parameters(vae.decoder), views * samples, vae.decode, latents))
    if "detail" in parts:
        given = detail_input(one, one, one, one, rgb, one)
        rows.append(_row("two", "detail", shared * _parameters(parts["detail"]), views, parts["detail"], given))
    return rows


def vit_flops(
    side: int = 64, width: int = 1024, blocks: int = 24, everywhere: int = 4, window: int = 14, patch: int = 16
) -> int:
    """Count the image encoder of SAM (Kirillov et al. 2023), ViT-L on 1024 x 1024 by default, as 2 per multiply-add.

    Args:
        side: tokens per side of the image.
        width: channels of a token.
        blocks: transformer blocks, each an attention and an MLP four times as wide.
        everywhere: how many of them attend to all tokens; the others only within windows, padded to whole ones.
        window: tokens per side of a window.
        patch: pixels per side of a token.
    """

    def attention(tokens: int, reach: int) -> int:  # four projections, scores and mixing, relative positions
        return tokens * width * (4 * width + 2 * reach**2 + 2 * reach)

    tokens, padded = side**2, (-(-side // window) * window) ** 2
    mixing = everywhere * attention(tokens, side) + (blocks - everywhere) * attention(padded, window)
    neck = tokens * (256 * width + 9 * 256 * 256)
    return 2 * (3 * patch**2 * width * tokens + mixing + blocks * 8 * width**2 * tokens + neck)


def beside_table_vi(rows: list[Row]) -> list[Row]:
    """Add up :func:`costs` by stage, beside what Table VI states of that stage.

    Returns:
        One {"stage", "parameters", "gflops", "gmacs", "paper_gflops", "paper_ms", "least_ms"} a stage; ``gmacs`` is
        ``gflops`` with a multiply-add counted once, ``least_ms`` the time that the paper's GPU needs at its peak rate.
    """
    table = []
    for stage, (paper_ms, paper_gflops) in TABLE_VI.items():
        chosen = [row for row in rows if row["stage"] == stage]
        gflops = sum(row["gflops"] * row["calls"] for row in chosen)
        table.append(
            {
                "stage": stage,
                "parameters": sum(row["parameters"] for row in chosen),
                "gflops": gflops,
                "gmacs": gflops / 2,
                "paper_gflops": paper_gflops,
                "paper_ms": paper_ms,
                "least_ms": 1000 * gflops / RTX_3090_GFLOPS,
            }
        )
    return table


@torch.no_grad()
def level_costs(
    net: DenoisingUNet, image: Tensor, latents: Tensor, known: Tensor, mask: Tensor, colour: list[Tensor] | None = None
) -> list[Row]:
    """Run the denoiser once and count it part by part, in the order in which they run.

    Args:
        net: the denoiser; on the meta device nothing is allocated.
        image: (B, Cin, H, W), what F(x) looks at.
        latents: (B, C, H/4, W/4), L_t.
        known: like ``latents``, the encoded known depth.
        mask: (B, 1, H/4, W/4), where it is known.
        colour: the pretrained encoder's features of the picture, where the denoiser takes any.

    Returns:
        One {"part", "shape", "parameters", "mflops", "attention"} a part; ``shape`` is that of its output, without the
        batch (of F(x): its coarsest map), ``attention`` whether self- and cross-attention sit there.
    """
    last = len(net.down) - 1
    parts = {"F(x), once": net.extractor, "stem": net.stem} | {f"down {i}": m for i, m in enumerate(net.down)}
    parts |= {"project": net.project}
    for i, (up, level) in enumerate(zip(net.upsample, net.up, strict=True), start=1):
        parts |= {f"2x2 to {last - i}": up, f"up {last - i}": level}
    parts |= {"out": net.out}
    seen = {}
    hooks = [m.register_forward_hook(lambda m, i, o: seen.update({m: (i, o)})) for m in parts.values()]
    steps = torch.zeros(len(latents), dtype=torch.long, device=latents.device)
    net(latents, steps, net.features(image, colour or []), known, mask)
    for hook in hooks:
        hook.remove()
    rows = []
    for name, module in parts.items():
        inputs, output = seen[module]
        shape = tuple((output[-1] if isinstance(output, list) else output).shape[1:])
        row = {"part": name, "shape": shape, "parameters": _parameters(module)}
        row["mflops"] = count_flops(module, *inputs) / 1e6
        row["attention"] = getattr(module, "attention", False)
        rows.append(row)
    return rows


def format_costs(rows: list[Row]) -> str:
    """Return :func:`costs` as a text table."""
    width = max(18, *(len(row["network"]) for row in rows))
    lines = [f"stage  {'network':{width}}   parameters    GFLOPs x calls  =   in all"]
    for row in rows:
        total = f"{row['gflops']:9,.1f} {row['calls']:7,d} {row['gflops'] * row['calls']:10,.0f}"
        lines.append(f"{row['stage']:6} {row['network']:{width}} {row['parameters']:12,d} {total}")
    return "\n".join(lines)


def _parameters(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def _row(stage: str, network: str, parameters: int, calls: int, fn, *inputs) -> Row:
    gflops = count_flops(fn, *inputs) / 1e9
    return {"stage": stage, "network": network, "parameters": parameters, "gflops": gflops, "calls": calls}
