"""The whole system: find the region, repaint both kinds of loss in latent space, compose.

Paper: Sec. IV-A and Fig. 5; Eq. 3, ``D_out = DITR(D_in given X)``.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from .autoencoder import VQAutoencoder
from .boundary import M_DA, M_RGB, boundary_maps, get_backend
from .conditioning import CHANNELS, Bounds, Frame, condition, depth_bounds, depth_tensors, fit, to_tensor
from .config import Config, StdConfig
from .detail import DetailNet, detail_input
from .diffusion import sample
from .region import RegionNet, refine_region, region_probability
from .schedule import make_schedule
from .store import load_parts
from .unet import DenoisingUNet
from .units import clean_depth


@dataclass(frozen=True)
class Completion:
    """What :class:`pipeline.Ditr` returns; all maps have the size of the input.

    Attributes:
        depth: (H, W) float32 metres, dense.
        region: (H, W) bool, after refinement (the caller's, if one was given).
        std: (H, W) float32 metres, the error to expect (one standard deviation), see :func:`expected_error`; 0 where
            depth was kept.
        boundary_rgb, boundary_depth, boundary_da: (H, W) bool, M_RGB, M_D and M_DA.
        probability: (H, W) float32, stage one's belief before threshold and refinement; None for a given region.
        optical, geometric: (H, W) float32 metres, each branch's own repainting before composition.
    """

    depth: np.ndarray
    region: np.ndarray
    std: np.ndarray
    boundary_rgb: np.ndarray
    boundary_depth: np.ndarray
    boundary_da: np.ndarray
    probability: np.ndarray | None
    optical: np.ndarray
    geometric: np.ndarray


def compose(depth: np.ndarray, optical: np.ndarray, geometric: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return the composed depth: the optical branch inside the region, the geometric one in holes, the rest kept.

    Paper: Sec. IV-A, "inside the mask, the depth values are re-estimated [...] outside the mask, the missing depth
    values are re-generated, and the original depth values are kept".

    Args:
        depth: (H, W) float32 raw metres, 0 = missing.
        optical: (H, W) float32 metres, dense.
        geometric: (H, W) float32 metres, dense.
        region: (H, W) bool.
    """
    return np.where(region, optical, np.where(depth > 0, depth, geometric)).astype(np.float32)


def expected_error(
    spread: np.ndarray, depth: np.ndarray, kept: np.ndarray, region: np.ndarray, config: StdConfig
) -> np.ndarray:
    """Return the error to expect of the mean of samples: their spread, scaled, and what no spread shows.

    Samples of one denoiser agree where it has learnt to be wrong: their spread alone understates the error. Per branch
    sqrt((base * depth)^2 + (factor * spread)^2), with constants that ``tools/calibrate.py`` fits on validation scenes.

    Args:
        spread: (H, W) metres, standard deviation over samples; 0 of a single one.
        depth: (H, W) metres, their mean.
        kept: (H, W) bool, pixels that were not painted: 0.
        region: (H, W) bool, painted by the optical branch.
        config: the constants.

    Returns:
        (H, W) float32 metres.
    """
    share, times = (np.where(region, *pair) for pair in (config.base, config.factor))
    return np.where(kept, 0, np.hypot(share * depth, times * spread)).astype(np.float32)


def check_inputs(
    rgb: np.ndarray, depth: np.ndarray, region: np.ndarray | None, samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Check a frame and return it as arrays: its image, its depth as clean float32 metres, its region or None.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float metres; NaN, infinite, negative and absurd readings become 0, missing.
        region: (H, W) bool, or None.
        samples: at least 1.

    Raises:
        ValueError: naming what was expected, what came, and what to do.
    """
    rgb, depth = np.asarray(rgb), np.asarray(depth)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ValueError(
            f"rgb: expected (H, W, 3) uint8, got {rgb.shape} {rgb.dtype}; convert grey or RGBA images to RGB"
        )
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(
            f"depth: expected (H, W) float metres, got {depth.shape} {depth.dtype}; divide millimetres by 1000"
        )
    if rgb.shape[:2] != depth.shape:
        raise ValueError(f"rgb is {rgb.shape[:2]} and depth {depth.shape}: align depth to the RGB image first")
    region = None if region is None else np.asarray(region)
    if region is not None and (region.shape != depth.shape or region.dtype != bool):
        raise ValueError(f"region: expected {depth.shape} bool, got {region.shape} {region.dtype}")
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples}")
    depth = clean_depth(depth)
    if not (depth > 0).any():
        raise ValueError(
            "depth holds no reading (all pixels are 0, negative or not finite); completion needs some depth"
        )
    return rgb, depth, region


BRANCHES = ("optical", "geometric")
GUIDES: dict[str, int | None] = {"optical": M_DA, "geometric": M_RGB}  # Sec. IV-C; None would be an empty map


def build(config: Config) -> nn.ModuleDict:
    """Return the untrained networks of a configuration, by the names of their weight files."""
    latent = config.autoencoder.latent_channels
    parts = {
        "region": RegionNet(config.region),
        "autoencoder": VQAutoencoder(config.autoencoder),
        "optical": DenoisingUNet(config.unet, latent, len(CHANNELS)),
        "geometric": DenoisingUNet(config.unet, latent, len(CHANNELS)),
    }
    if config.detail.width:
        parts["detail"] = DetailNet(config.detail)
    return nn.ModuleDict(parts)


class Ditr:
    """Two-stage latent-diffusion depth completion.

    Args:
        parts: the trained networks, as :func:`build` names them.
        config: what they were built from.
        boundary: name of a boundary backend (``boundary.BACKENDS``).
        boundary_path: its files, if it needs any.
        device: torch device.
    """

    def __init__(
        self,
        parts: nn.ModuleDict,
        config: Config,
        boundary: str = "classical",
        boundary_path: Path | str | None = None,
        device: str | torch.device = "cpu",
    ):
        self.config, self.device = config, torch.device(device)
        self.parts = parts.to(self.device, memory_format=torch.channels_last).eval().requires_grad_(False)
        self.schedule = make_schedule(config.schedule)
        self.backend = get_backend(boundary, boundary_path)
        self.painters, self.guides = BRANCHES, GUIDES  # who paints region and holes, and by which boundary map

    @classmethod
    def from_pretrained(
        cls,
        path: Path | str | None = None,
        device: str | torch.device = "cpu",
        preset: str = "lite",
        boundary: str = "classical",
        boundary_path: Path | str | None = None,
    ) -> "Ditr":
        """Load trained weights: the shipped ones of a preset, or those in the folder ``path``.

        Raises:
            ValueError: for missing or damaged weights, or an unknown preset or boundary backend.
        """
        config, states = load_parts(path, preset)
        parts = build(config)
        for name, module in parts.items():
            try:
                module.load_state_dict(states[name])
            except RuntimeError:  # its message is a page of tensor names
                raise ValueError(f"the {name} weights do not fit the sizes in their card; restore both") from None
        return cls(parts, config, boundary, boundary_path, device)

    @torch.no_grad()
    def __call__(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        region: np.ndarray | None = None,
        steps: int | None = None,
        samples: int | None = None,
        adjust: bool = False,
        seed: int = 0,
    ) -> Completion:
        """Complete one frame (Paper: Eq. 3).

        Args:
            rgb: (H, W, 3) uint8.
            depth: (H, W) float metres, aligned to ``rgb``, 0 = missing.
            region: (H, W) bool, transparent or reflective; None lets stage one find it.
            steps: denoising steps, 1 to the schedule's length; None for the configuration's.
            samples: draws whose mean is returned; ``std`` rests on their spread; None for the configuration's.
            adjust: also repaint valid pixels outside the region; by default they are returned bit for bit.
            seed: of the noise.

        Raises:
            ValueError: for inputs of the wrong type or shape, depth without any reading, or counts below 1.
        """
        steps = self.config.sampler.steps if steps is None else steps
        samples = self.config.sampler.samples if samples is None else samples
        rgb, depth, region = check_inputs(rgb, depth, region, samples)
        frame, bounds = fit(depth.shape, self.config.size), depth_bounds(depth)
        small_rgb, small = frame.into(rgb), frame.into(depth)
        probability = None
        if region is None:
            probability, small_region = self.find_region(small_rgb, small, bounds, frame)
            region = frame.back(small_region)
        else:
            small_region = frame.into(region)
        maps = frame.on_picture(boundary_maps, small_rgb, small, backend=self.backend)
        optical, geometric = self.inpaint(small_rgb, small, small_region, maps, bounds, steps, samples, seed)
        parts = [[frame.back(d) for d in branch] for branch in (optical, geometric)]  # samples of (H, W) each
        means = [np.mean(branch, axis=0) for branch in parts]
        kept = np.zeros_like(depth) if adjust else depth
        drawn = (compose(kept, o, g, region) for o, g in zip(*parts, strict=True))
        mean = compose(kept, *means, region)
        variance = sum(np.square(d - mean) for d in drawn) / max(samples - 1, 1)  # where depth was kept exactly 0
        return Completion(
            depth=mean,
            region=region,
            std=expected_error(np.sqrt(variance), mean, (kept > 0) & ~region, region, self.config.std),
            boundary_rgb=frame.back(maps[0]),
            boundary_depth=frame.back(maps[1]),
            boundary_da=frame.back(maps[2]),
            probability=None if probability is None else frame.back(probability),
            optical=means[0],
            geometric=means[1],
        )

    def find_region(self, rgb: np.ndarray, depth: np.ndarray, bounds: Bounds, frame: Frame) -> tuple[np.ndarray, ...]:
        """Run stage one at the working size: probability and refined region, which leaves the padding out; (H, W)."""
        probability = self.region_probability(rgb, depth, bounds)
        return probability, self.refine(probability > 0.5) & frame.picture

    def region_probability(self, rgb: np.ndarray, depth: np.ndarray, bounds: Bounds) -> np.ndarray:
        """Run stage one at the working size: (H, W) float32 probability of transparent or reflective."""
        depth_n, valid = depth_tensors(depth, bounds)
        outputs = self.parts["region"](*self._put(to_tensor(rgb[None]), depth_n, valid))
        return region_probability(outputs)[0, 0].cpu().numpy()

    def refine(self, mask: np.ndarray) -> np.ndarray:
        """Refine a mask with the configuration's kernels (Paper: Sec. IV-B)."""
        r = self.config.refine
        return refine_region(mask, r.median, r.dilate, r.iterations)

    def inpaint(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        region: np.ndarray,
        maps: tuple[np.ndarray, np.ndarray, np.ndarray],
        bounds: Bounds,
        steps: int,
        samples: int,
        seed: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run stage two at the working size.

        Args:
            rgb: (H, W, 3) uint8; this and all other maps at the working size.
            depth: (H, W) float32 metres.
            region: (H, W) bool.
            maps: M_RGB, M_D, M_DA.
            bounds: of the frame.
            steps: of the sampler.
            samples: to draw.
            seed: of the noise.

        Returns:
            optical and geometric repaintings, each (samples, H, W) float32 metres.
        """
        depth_n, valid = depth_tensors(depth, bounds)
        image, mask = to_tensor(rgb[None]), torch.from_numpy(region)[None, None].float()
        edges = [torch.from_numpy(m)[None, None].float() for m in maps]
        painted = {}
        for branch in dict.fromkeys(self.painters):  # one that paints everything does so once
            guide = torch.zeros_like(mask) if self.guides[branch] is None else edges[self.guides[branch]]
            given = condition(image, depth_n, valid, mask, guide, self.config.evidence and branch == "optical")
            generator = torch.Generator().manual_seed(2 * seed + BRANCHES.index(branch))
            painted[branch] = self.decode(self.denoise(branch, *given, steps, samples, generator))
        decoded = [painted[branch] for branch in self.painters]
        if "detail" in self.parts:
            decoded = self.sharpen(decoded, image, depth_n, valid, mask, edges[M_RGB])
        # metric depth is positive, whatever a network says; sparse readings may all be lost on the way to this size
        low = 0.25 * float(depth.min(where=depth > 0, initial=bounds.high))
        return tuple(np.maximum(bounds.denormalise(d[:, 0].cpu().numpy()), low).astype(np.float32) for d in decoded)

    def denoise(
        self,
        branch: str,
        image: Tensor,
        filled: Tensor,
        known: Tensor,
        steps: int,
        samples: int,
        generator: torch.Generator,
    ) -> Tensor:
        """Sample latents (samples, C, H/4, W/4) of one branch given what :func:`conditioning.condition` assembled."""
        net = self.parts[branch]
        image, filled, known = self._put(image, filled, known)
        features = [f.expand(samples, -1, -1, -1) for f in net.features(image)]
        masked = self.parts["autoencoder"].encode(filled).expand(samples, -1, -1, -1)
        known = known.expand(samples, -1, -1, -1)
        noise = torch.randn(masked.shape, generator=generator).to(self.device)
        return sample(
            lambda x, t: net(x, t, features, masked, known),
            masked.shape,
            self.schedule,
            steps,
            self.config.sampler.prediction,
            generator=generator,
            x_T=noise,
        )

    def decode(self, latents: Tensor) -> Tensor:
        """Decode latents (S, C, h, w) to normalised depth (S, 1, H, W)."""
        return self.parts["autoencoder"].decode(latents)

    def sharpen(
        self, decoded: list[Tensor], image: Tensor, depth_n: Tensor, valid: Tensor, region: Tensor, boundary: Tensor
    ) -> list[Tensor]:
        """Apply the finer final step to the branches composed as they will be, each being returned where it is used.

        Elsewhere a branch keeps what it had painted. Affinities are predicted once, from the mean of the samples.
        """
        inside = region.to(self.device) > 0
        together = torch.where(inside, *decoded)
        given = self._put(depth_n, valid, region, image, boundary)
        finer = self.parts["detail"].spread(detail_input(together.mean(0, keepdim=True), *given), together)
        return [torch.where(inside, finer, decoded[0]), torch.where(inside, decoded[1], finer)]

    def _put(self, *tensors: Tensor) -> list[Tensor]:
        return [t.to(self.device, memory_format=torch.channels_last) for t in tensors]
