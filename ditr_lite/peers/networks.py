"""Learned peers of DITR: a small stand-in for one idea of each compared system, never the system itself.

Paper: Sec. V-C compares with eleven systems. Trained on the same scenes, for the same time, at the same working size,
an idea can be compared with DITR's, which different data, hardware and sizes forbid otherwise:

========================  ===========================================================  =========================
name                      idea                                                         after
========================  ===========================================================  =========================
regression                one U-Net from colour and raw depth to depth                 DFNet
rgb_only                  depth from colour alone, in metres                           DenseDepth, SRD, MiDaS
rgb_only_aligned          the same, scaled and shifted to the readings outside         MiDaS
normals_optimisation      predict orientation and edges, then solve for depth          DeepCompletion, ClearGrasp
two_stream_confidence     a prediction and the sensor, blended by learnt confidence    SwinDRNet
single_latent_diffusion   one latent denoiser for all, no region                       LDM; BB of Table IV
========================  ===========================================================  =========================
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..baselines import Fill
from ..boundary import M_RGB, boundary_maps, get_backend
from ..conditioning import CHANNELS, Bounds, depth_bounds, depth_tensors, fill, to_tensor
from ..config import Config, from_dict
from ..evaluation.protocols import fitted
from ..pipeline import build
from ..region import Encoder
from ..schedule import make_schedule
from ..stage_two import Painter, Views, paint
from ..store import load_part, read_card
from ..unet import DenoisingUNet, norm
from ..units import without_strays
from ..windows import fit_frame
from .gradient_solve import solve

WIDTH, LEVELS = 16, 5  # of the U-Nets at pixel size
TYPICAL_M = 0.7  # rgb_only begins here
NETS = {  # name -> channels in and out
    "regression": (5, 1),
    "rgb_only": (3, 1),
    "normals_optimisation": (5, 3),
    "two_stream_confidence": (5, 3),
}
NAMES = (*NETS, "single_latent_diffusion")


class PixelUNet(nn.Module):
    """A U-Net with stage one's encoder whose last step also sees the pixels themselves, folded into channels.

    Args:
        channels_in: of the image.
        channels_out: of the result; the last convolution starts at zero.
        width: channels at half size; doubled at every further level.
        levels: sizes 1/2, 1/4, ...
    """

    def __init__(self, channels_in: int, channels_out: int, width: int = WIDTH, levels: int = LEVELS):
        super().__init__()
        widths = [width * 2**k for k in range(levels)]
        self.encoder = Encoder(channels_in, width, levels)
        self.decode = nn.ModuleList(_conv(3 * w, w) for w in reversed(widths[:-1]))
        self.last = _conv(width + 4 * channels_in, 2 * width)
        self.out = nn.Conv2d(2 * width, 4 * channels_out, 3, padding=1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, image: Tensor) -> Tensor:
        """Map (B, channels_in, H, W) to (B, channels_out, H, W); H and W multiples of 2^levels."""
        *finer, x = self.encoder(image)
        for decode, fine in zip(self.decode, reversed(finer), strict=True):
            x = decode(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), fine], dim=1))
        x = self.last(torch.cat([x, F.pixel_unshuffle(image, 2)], dim=1))  # (B, 4 Cin, H/2, W/2) of pixels
        return F.pixel_shuffle(self.out(x), 2)


def _conv(channels_in: int, channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels_in, channels, 3, padding=1), norm(channels), nn.SiLU())


def build_peer(name: str, config: Config) -> nn.Module:
    """Return the untrained network of a peer.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in NAMES:
        raise ValueError(f"unknown peer {name!r}; choose one of {', '.join(NAMES)}")
    if name == "single_latent_diffusion":
        return DenoisingUNet(config.unet, config.autoencoder.latent_channels, len(CHANNELS))
    return PixelUNet(*NETS[name])


def network_input(name: str, rgb: Tensor, depth_n: Tensor, valid: Tensor) -> Tensor:
    """Return what a peer at pixel size sees: colour, and except for ``rgb_only`` raw depth and its validity."""
    return rgb if name == "rgb_only" else torch.cat([rgb, depth_n, valid], dim=1)


def predicted_depth(name: str, out: Tensor, depth_n: Tensor, valid: Tensor) -> Tensor:
    """Turn the output of a peer that predicts normalised depth into that depth (B, 1, H, W).

    Args:
        name: ``regression`` or ``two_stream_confidence``.
        out: (B, C, H, W) of the network.
        depth_n: (B, 1, H, W) raw.
        valid: (B, 1, H, W) 0/1.

    Raises:
        ValueError: for a peer that predicts something else.
    """
    if name not in ("regression", "two_stream_confidence"):
        raise ValueError(f"expected regression or two_stream_confidence, got {name!r}, which predicts something else")
    filled = fill(depth_n, valid)
    if name == "regression":
        return filled + out
    own, *confidences = out.split(1, dim=1)
    weights = torch.cat(confidences, dim=1).softmax(dim=1)  # (B, 2, H, W): the prediction's, the sensor's
    return weights[:, :1] * own + weights[:, 1:] * filled


def single_views(rgb: Tensor, depth_n: Tensor, valid: Tensor, guide: Tensor) -> Views:
    """Return what the single denoiser is given: all readings as known depth, no region."""
    return Views(rgb, depth_n, valid, torch.zeros_like(valid), guide, guide)


class Peer:
    """A trained peer in the baselines' call shape, ``f(rgb, depth, region) -> depth``: it paints the whole frame.

    Args:
        name: of the peer, or ``rgb_only_aligned``.
        net: its network.
        config: working size; of the diffusion, for ``single_latent_diffusion``.
        painter: that network with autoencoder and encoder, for ``single_latent_diffusion``.
    """

    def __init__(self, name: str, net: nn.Module, config: Config, painter: Painter | None = None):
        self.name, self.config, self.painter = name, config, painter
        self.net = net.eval().requires_grad_(False).to(memory_format=torch.channels_last)

    @torch.no_grad()
    def __call__(self, rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None = None) -> np.ndarray:
        """Return (H, W) float32 metres, dense. ``region`` only says which readings a fit or a solve must not trust."""
        frame = fit_frame(depth.shape, self.config.size)
        picture = frame.into(rgb)
        small = without_strays(frame.into(depth))
        bounds = depth_bounds(small)
        image = to_tensor(picture[None])
        depth_n, valid = depth_tensors(small, bounds)
        if self.name == "single_latent_diffusion":
            guide = frame.on_picture(boundary_maps, picture, small, backend=get_backend("classical"))[M_RGB]
            views = single_views(image, depth_n, valid, torch.from_numpy(guide)[None, None].float())
            metres = self._denoise(views, bounds)
        else:
            outside = small if region is None else np.where(frame.into(region), 0, small)
            if not outside.any():  # nothing but the region was read: better than nothing
                outside = small
            name = self.name.removesuffix("_aligned")
            out = self.net(network_input(name, image, depth_n, valid))
            metres = self._read(name, out, depth_n, valid, bounds, outside)
        low = 0.25 * float(small[small > 0].min())  # as DITR: metric depth is positive
        return frame.back(np.maximum(metres, low).astype(np.float32))

    def _read(
        self, name: str, out: Tensor, depth_n: Tensor, valid: Tensor, bounds: Bounds, outside: np.ndarray
    ) -> np.ndarray:
        if name == "rgb_only":
            metres = TYPICAL_M * np.exp(out[0, 0].numpy())
            return fitted(metres, outside) if self.name == "rgb_only_aligned" else metres
        if name == "normals_optimisation":
            return solve(outside, out[0, :2].numpy(), torch.sigmoid(out[0, 2]).numpy())
        return bounds.denormalise(predicted_depth(name, out, depth_n, valid)[0, 0].numpy())

    def _denoise(self, views: Views, bounds: Bounds) -> np.ndarray:
        sampler = self.config.sampler
        schedule = make_schedule(self.config.schedule)
        generator = torch.Generator().manual_seed(0)
        drawn = paint(
            self.painter, views, schedule, sampler.steps, sampler.samples, sampler.prediction, generator
        )  # (S, 1, 1, H, W)
        return bounds.denormalise(drawn[:, 0, 0].numpy()).mean(axis=0)


def single_painter(net: nn.Module, config: Config, weights: Path | str | None = None) -> Painter:
    """Return the single denoiser with the autoencoder, and the colour encoder if it needs one, of a weights folder.

    Raises:
        ValueError: when one of them is missing.
    """
    parts = build(config)
    for name in ("autoencoder", "encoder"):
        if name in parts:
            parts[name].load_state_dict(load_part(name, weights))
            parts[name].eval().requires_grad_(False)
    encoder = parts["encoder"] if "encoder" in parts else None
    return Painter(net, parts["autoencoder"], encoder, detail=None, evidence=False)


def load_peers(folder: Path | str, seed: int = 0, weights: Path | str | None = None) -> dict[str, Fill]:
    """Return name -> call of all peers in a folder that ``tools/train_peer.py`` wrote.

    Args:
        folder: of the peers.
        seed: that they were trained with.
        weights: folder of the autoencoder, and of the colour encoder; None for the shipped one.

    Raises:
        ValueError: when there is none.
    """
    card = read_card(folder)
    config = from_dict(card["config"])
    found: dict[str, Callable] = {}
    for name in NAMES:
        if f"{name}-{seed}" not in card["parts"]:
            continue
        net = build_peer(name, config)
        net.load_state_dict(load_part(f"{name}-{seed}", folder))
        painter = single_painter(net, config, weights) if name == "single_latent_diffusion" else None
        found[name] = Peer(name, net, config, painter)
        if name == "rgb_only":
            found["rgb_only_aligned"] = Peer("rgb_only_aligned", net, config)
    if not found:
        raise ValueError(f"no peers of seed {seed} in {folder}: train them with `python tools/train_peer.py NAME`")
    return found
