"""The whole system: find the region, repaint both kinds of loss in latent space, compose.

Paper: Sec. IV-A and Fig. 5; Eq. 3, ``D_out = DITR(D_in given X)``.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from . import diffusion
from .autoencoder import VQAutoencoder
from .boundary import M_D, M_DA, M_RGB, Backend, boundary_maps, get_backend, own_backend
from .conditioning import CHANNELS, Bounds, depth_bounds, depth_tensors, to_tensor
from .config import Config, RefineConfig, check_stage_one
from .detail import DetailNet
from .metrics import expected_error
from .region import ColourEncoder, RegionNet, refine_region
from .schedule import make_schedule
from .stage_two import BRANCHES, Painter, Plan, Sampler, Views, paint
from .store import checked_denoiser, checked_logits, checked_sampler, load_parts, usable_device
from .unet import STRIDE, DenoisingUNet
from .units import MAX_SEED, MIN_DEPTH_M, check_count, check_inputs, strips, without_strays
from .windows import Claim, Completion, Frame, Layer, Painting, close_ups, fit_frame, level


def compose(depth: np.ndarray, optical: np.ndarray, geometric: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Return the composed depth: the optical branch inside the region, the geometric one in holes, the rest kept.

    Paper: Sec. IV-A, "Inside the mask, the depth values are re-estimated [...] Outside the mask, the missing depth
    values are re-generated, and the original depth values are kept or adjusted" (``adjust=True`` of :class:`Ditr`).

    Args:
        depth: (H, W) float32 raw metres, 0 = missing.
        optical: (H, W) float32 metres, dense.
        geometric: (H, W) float32 metres, dense.
        region: (H, W) bool.
    """
    out = np.where(depth > 0, depth, geometric).astype(np.float32, copy=False)
    np.copyto(out, optical, where=region, casting="same_kind")
    return out


def build(config: Config) -> nn.ModuleDict:
    """Return the untrained networks of a configuration, by the names of their weight files."""
    latent = config.autoencoder.latent_channels
    parts = {
        "region": RegionNet(config.region),
        "autoencoder": VQAutoencoder(config.autoencoder),
        "optical": DenoisingUNet(config.unet, latent, len(CHANNELS)),
        "geometric": DenoisingUNet(config.unet, latent, len(CHANNELS)),
    }
    if config.unet.colour_channels:
        parts["encoder"] = ColourEncoder()
    if config.detail.width:
        parts["detail"] = DetailNet(config.detail)
    return nn.ModuleDict(parts)


class Ditr:
    """Two-stage latent-diffusion depth completion.

    Args:
        parts: the trained networks, as :func:`build` names them.
        config: what they were built from.
        boundary: name of a boundary backend (``boundary.BACKENDS``), or your own: a call that takes a picture (h, w, 3)
            uint8 or a depth map (h, w) float32 metres, 0 = missing, and returns its boundaries, (h, w) bool.
        boundary_path: files of a named backend, if it needs any.
        device: torch device.
        sampler: of latents, called like :func:`diffusion.sample`, the default: ``sampler(predict, shape, schedule,
            steps, prediction, generator=..., x_T=...)`` returns latents of that shape. ``predict(x_t, t)`` is the
            denoiser, of latents (N, C, h, w) and step t; ``x_T`` is the noise to begin with.

    Raises:
        ValueError: for an unknown backend, a device that is not there, or latents of another size than the denoiser's.
    """

    def __init__(
        self,
        parts: nn.ModuleDict,
        config: Config,
        boundary: str | Backend = "classical",
        boundary_path: Path | str | None = None,
        device: str | torch.device = "cpu",
        sampler: Sampler = diffusion.sample,
    ):
        if 2 ** len(config.autoencoder.multipliers) != STRIDE:
            raise ValueError(f"autoencoder.multipliers: expected 2 levels, got {config.autoencoder.multipliers}")
        self.config, self.device = config, usable_device(device)
        self.parts = parts.to(self.device, memory_format=torch.channels_last).eval().requires_grad_(False)
        self.schedule = make_schedule(config.schedule)
        self.backend = own_backend(boundary) if callable(boundary) else get_backend(boundary, boundary_path)
        own = sampler is not diffusion.sample
        self.sampler = checked_sampler(sampler if own else partial(sampler, eta=config.sampler.eta))

    @classmethod
    def from_pretrained(
        cls,
        path: Path | str | None = None,
        device: str | torch.device = "cpu",
        preset: str | None = None,
        boundary: str | Backend = "classical",
        boundary_path: Path | str | None = None,
        sampler: Sampler = diffusion.sample,
    ) -> "Ditr":
        """Load trained weights: the shipped ones, or those in the folder ``path``.

        Args:
            path: weights folder; None for the shipped one.
            device: as for the class.
            preset: that the weights must be of; None for whichever they are.
            boundary: as for the class.
            boundary_path: likewise.
            sampler: likewise.

        Raises:
            ValueError: for missing, damaged or mixed weights, those of another preset, an unknown preset or boundary
                backend, or a device that is not there.
        """
        config, states = load_parts(path, preset)
        parts = build(config)
        for name, module in parts.items():
            try:
                module.load_state_dict(states[name])
            except (RuntimeError, KeyError):  # its message is a page of tensor names
                raise ValueError(f"the {name} weights do not fit the sizes in their card; restore both") from None
        return cls(parts, config, boundary, boundary_path, device, sampler)

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
        threshold: float | None = None,
        refine: RefineConfig | None = None,
    ) -> Completion:
        """Complete one frame (Paper: Eq. 3).

        Args:
            rgb: (H, W, 3) uint8.
            depth: (H, W) float metres, aligned to ``rgb``, 0 = missing.
            region: (H, W) bool, transparent or reflective; None lets stage one find it.
            steps: denoising steps, 1 to the schedule's length; None for the configuration's.
            samples: draws whose mean is returned; ``std`` rests on their spread; None for the configuration's.
            adjust: also repaint valid pixels outside the region; by default they are returned bit for bit. Holes are
                given the level of the readings around them, repainted readings are not: a step may show between them.
            seed: of the noise.
            threshold: probability above which stage one claims a pixel; None for the configuration's.
            refine: kernels of the refinement of what was claimed; None for the configuration's.

        Raises:
            ValueError: for inputs of the wrong type or shape, depth without any reading, or counts below 1.
        """
        steps = self.config.sampler.steps if steps is None else steps
        samples = self.config.sampler.samples if samples is None else samples
        check_count("steps", steps, 1, self.config.schedule.timesteps)
        seed = check_count("seed", seed, 0, MAX_SEED)
        check_stage_one(threshold, refine, self.config.refine)
        rgb, depth, region = check_inputs(rgb, depth, region, samples)
        found = None
        if region is None:
            found = self.claim(rgb, depth, threshold, refine)
            region = found.frame.back(found.region)
        painting = self.inpaint(rgb, depth, region, steps, samples, seed)
        kept = np.zeros_like(depth) if adjust else depth
        mean = painting.compose(kept, region)
        back = painting.whole.view.back
        return Completion(
            depth=mean,
            region=region,
            std=self.stated(painting, mean, (kept > 0) & ~region, region, found),
            boundary_rgb=partial(back, painting.boundaries[M_RGB]),
            boundary_depth=partial(back, painting.boundaries[M_D]),
            boundary_da=partial(back, painting.boundaries[M_DA]),
            probability=found and partial(back, found.probability),
            optical=partial(getattr, painting, "optical"),
            geometric=partial(getattr, painting, "geometric"),
            windows=painting.windows,
            classes=found and found.class_map,
        )

    def stated(
        self, painting: Painting, mean: np.ndarray, kept: np.ndarray, region: np.ndarray, found: Claim | None
    ) -> np.ndarray:
        """Return :func:`expected_error` of a composed frame, (H, W) float32 metres."""
        out = painting.spread(region)  # first, while one map of the frame's size less is in memory
        doubt = np.zeros_like(mean) if found is None else found.frame.back(found.probability)
        for rows in strips(mean.shape):
            out[rows] = expected_error(*(m[rows] for m in (out, mean, kept, region, doubt)), self.config.std)
        return out

    @torch.no_grad()
    def find_region(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        threshold: float | None = None,
        refine: RefineConfig | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run stage one on a whole frame (Paper: Sec. IV-B).

        Args:
            rgb: (H, W, 3) uint8.
            depth: (H, W) float32 metres, clean.
            threshold: as in :meth:`__call__`.
            refine: likewise.

        Returns:
            (H, W) float32 probability and (H, W) bool region, refined at the working size.
        """
        found = self.claim(rgb, depth, threshold, refine)
        return found.frame.back(found.probability), found.frame.back(found.region)

    @torch.no_grad()
    def claim(
        self, rgb: np.ndarray, depth: np.ndarray, threshold: float | None = None, refine: RefineConfig | None = None
    ) -> Claim:
        """Return what stage one says of a frame, at the working size; arguments as for :meth:`find_region`."""
        frame, classes = self.classify(rgb, depth)
        claimed = 1 - classes[0] > (self.config.refine.threshold if threshold is None else threshold)
        return self.claim_of(frame, classes, claimed, refine)

    def claim_of(self, frame: Frame, classes: np.ndarray, claimed: np.ndarray, refine: RefineConfig | None) -> Claim:
        """Return the claim that follows from (classes, h, w) probabilities and from what is claimed, (h, w) bool."""
        likelier = np.where(claimed, 1 + classes[1:].argmax(axis=0), 0).astype(np.uint8)
        region = self.refine(claimed & frame.picture, refine)  # the padding is no glass, and none grows out of it
        return Claim(frame, 1 - classes[0], likelier, region)

    @torch.no_grad()
    def classify(self, rgb: np.ndarray, depth: np.ndarray) -> tuple[Frame, np.ndarray]:
        """Return how the frame lies in the working size and (classes, h, w) probabilities there, calibrated."""
        refine, frame = self.config.refine, fit_frame(depth.shape, self.config.size)
        logits = [self.region_logits(rgb, depth, scale) for scale in refine.looks]
        mean = torch.stack(logits).mean(0)  # (looks, classes, h, w) -> (classes, h, w)
        return frame, (mean / refine.temperature).softmax(dim=0).cpu().numpy()

    def region_logits(self, rgb: np.ndarray, depth: np.ndarray, scale: float) -> Tensor:
        """Return stage one's logits (classes, h, w) at the working size, from a look at ``scale`` times that size."""
        frame = fit_frame(depth.shape, self.config.look(scale))
        small = without_strays(frame.into(depth))
        seen = self._put(to_tensor(frame.into(rgb)[None]), *depth_tensors(small, depth_bounds(small)))
        logits = checked_logits(self.parts["region"](*seen), self.config.region.classes, seen[1])
        return F.interpolate(logits, size=self.config.size, mode="bilinear", antialias=True)[0]

    def refine(self, mask: np.ndarray, kernels: RefineConfig | None = None) -> np.ndarray:
        """Refine a mask at the working size (Paper: Sec. IV-B), with the configuration's kernels unless others come."""
        kernels = kernels or self.config.refine
        return refine_region(mask, kernels.median, kernels.dilate, kernels.iterations)

    def boundaries(self, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return M_RGB, M_D and M_DA of a whole frame, each (H, W) bool, found at the working size."""
        frame = fit_frame(depth.shape, self.config.size)
        return tuple(frame.back(m) for m in self.outlines(frame, frame.into(rgb), frame.into(depth)))

    def outlines(self, frame: Frame, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return M_RGB, M_D and M_DA, each (h, w) bool, of a frame at the working size, but not of its padding."""
        return frame.on_picture(boundary_maps, rgb, without_strays(depth), backend=self.backend)

    @torch.no_grad()
    def inpaint(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        region: np.ndarray,
        steps: int = 1,
        samples: int = 1,
        seed: int = 0,
        plan: Plan = Plan(),  # noqa: B008  frozen
    ) -> Painting:
        """Run stage two: the holes on the whole frame, the region in windows of its own.

        Args:
            rgb: (H, W, 3) uint8.
            depth: (H, W) float32 metres, clean.
            region: (H, W) bool.
            steps: of the sampler.
            samples: to draw.
            seed: of the noise.
            plan: who paints what, guided by what.
        """
        frame = fit_frame(depth.shape, self.config.size)
        small = tuple(frame.into(image) for image in (rgb, depth, region))
        maps = self.outlines(frame, *small[:2])
        views, bounds = self.look([small], plan.guides[1], False, [maps])
        mean, spread = self.paint(1, views, bounds, steps, samples, seed, plan)
        whole = Layer(mean[0], spread[0], frame)
        holes = np.packbits((depth == 0) | region, axis=1)
        painting = Painting(whole, (), level(frame.back(mean[0]), depth, region), holes, maps)
        if not self.config.window:  # the paper's: the whole frame here, too
            views, bounds = self.look([small], plan.guides[0], False, [maps])
            mean, spread = self.paint(0, views, bounds, steps, samples, seed, plan)
            return replace(painting, close=(Layer(mean[0], spread[0], frame),))
        close = close_ups(rgb, depth, region, self.config.window, lambda: painting.geometric, plan.rim)
        if not close:
            return painting
        views, bounds = self.look([shown for *_, shown in close], plan.guides[0], True)
        mean, spread = self.paint(0, views, bounds, steps, samples, seed, plan)
        layers = []
        for i, (window, pixels, inner, _) in enumerate(close):
            layers.append(Layer(mean[i], spread[i], inner, window, pixels))
        return replace(painting, close=tuple(layers))

    def look(
        self,
        pictures: list[tuple[np.ndarray, ...]],
        guide: int | None,
        around: bool,
        boundaries: list[tuple[np.ndarray, ...]] | None = None,
    ) -> tuple[Views, Bounds]:
        """Turn pictures at network size into what a branch is given.

        Args:
            pictures: rgb (h, w, 3) uint8, depth (h, w) metres with a reading, and region (h, w) bool of each.
            guide: which boundary map guides the branch; None for an empty one.
            around: take the bounds of each from the readings outside its region alone.
            boundaries: M_RGB, M_D and M_DA of each, (h, w) bool; None to find them.

        Returns:
            the views, on the device, and their bounds as tensors (B, 1, 1, 1).
        """
        rows, limits = [], []
        for i, (rgb, depth, region) in enumerate(pictures):
            depth = without_strays(depth)
            bounds = depth_bounds(depth, ~region if around else None)
            depth_n, valid = depth_tensors(depth, bounds)
            maps = boundaries[i] if boundaries else boundary_maps(rgb, depth, self.backend)
            guiding = np.zeros_like(region) if guide is None else maps[guide]
            masks = [torch.from_numpy(m)[None, None].float() for m in (region, guiding, maps[M_RGB])]  # (1, 1, h, w)
            rows.append((to_tensor(rgb[None]), depth_n, valid, *masks))
            limits.append((bounds.low, bounds.high))
        columns = (torch.cat(column) for column in zip(*rows, strict=True))
        low, high = torch.tensor(limits, dtype=torch.float32).T.reshape(2, -1, 1, 1, 1)  # (B, 2) -> two (B, 1, 1, 1)
        return Views(*self._put(*columns)), Bounds(low, high)

    def painter(self, branch: str, plan: Plan = Plan()) -> Painter:  # noqa: B008  frozen
        """Return the networks of one branch."""
        parts = dict(self.parts.items())
        return Painter(
            net=checked_denoiser(parts[branch], branch),
            autoencoder=parts["autoencoder"],
            encoder=parts.get("encoder"),
            detail=parts.get("detail") if plan.detail else None,
            evidence=plan.evidence and self.config.evidence and branch == "optical",
        )

    def paint(
        self, target: int, views: Views, bounds: Bounds, steps: int, samples: int, seed: int, plan: Plan
    ) -> tuple[np.ndarray, np.ndarray]:
        """Paint views of one target, 0 the region, 1 the holes: mean and spread over samples, (B, h, w) metres each."""
        if not (plan.evidence and self.config.evidence):
            views = views.without_evidence()
        branch = plan.painters[target]
        generator = torch.Generator().manual_seed(2 * seed + BRANCHES.index(branch))
        prediction = self.config.sampler.prediction
        painter = self.painter(branch, plan)
        drawn = paint(painter, views, self.schedule, steps, samples, prediction, generator, self.sampler).cpu()
        metres = bounds.denormalise(drawn)[:, :, 0]  # (S, B, 1, h, w) -> (S, B, h, w)
        metres = metres.clamp(min=MIN_DEPTH_M)  # 0 would mean: nothing there
        spread = metres.std(dim=0) if samples > 1 else torch.zeros_like(metres[0])
        return metres.mean(dim=0).numpy(), spread.numpy()

    def _put(self, *tensors: Tensor) -> list[Tensor]:
        return [t.to(self.device, memory_format=torch.channels_last) for t in tensors]
