"""Learned peers of DITR: a small stand-in for one idea of each compared system, never the system itself.

Paper: Sec. V-C compares with eleven systems. Here every idea paints the same views from the same evidence in the same
frame of reference as DITR's branches (``stage_two.Views``: windows around the region, whole frames for the holes; log
depth between bounds that the readings give), with the same pretrained features of colour, at the same capacity, after
the same training time on the same scenes. So the idea is what is compared, which different data, hardware and sizes
forbid otherwise.

=======================  ============================================================  =======================
name                     idea                                                          after
=======================  ============================================================  =======================
regression               one U-Net from colour and raw depth to depth                  DFNet
rgb_only                 depth from colour alone                                       DenseDepth
rgb_only_aligned         the same, scaled and shifted to the readings outside          MiDaS
normals_optimisation     predict orientation and edges, then solve for depth           DeepCompletion, ClearGrasp
two_stream_confidence    a prediction and the sensor, blended by learnt confidence     SwinDRNet
implicit_rays            ask points along each ray whether it ends there               LIDF
point_completion         lift to points, complete them, project                        TranspareNet
adversarial              a critic tells painted depth from true depth                  DepthGrasp
self_supervised          colour alone, taught and scaled by the sensor's readings      SRD
single_latent_diffusion  one latent denoiser for all, no region                        LDM; BB of Table IV
=======================  ============================================================  =======================
"""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from ..conditioning import CHANNELS, Bounds, condition, fill
from ..config import Config
from ..evaluation.protocols import fitted
from ..stage_two import Views, cl
from ..training.batches import Batch
from ..training.losses import ELSEWHERE, orientation_loss
from .gradient_solve import solve
from .networks import Critic, PixelUNet, perceptron

Losses = dict[str, Tensor]
Colour = Sequence[Tensor]
OFFSET = CHANNELS.index("evidence")  # how far a fill from all readings lies from a fill from those outside


class Idea(nn.Module):
    """A network that paints views. A subclass says what it predicts and what it is scored by.

    Args:
        config: sizes; of the pretrained features.
    """

    elsewhere = ELSEWHERE

    def __init__(self, config: Config):
        super().__init__()
        self.colour_channels = config.unet.colour_channels

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Return normalised depth (B, 1, H, W) of views, given pretrained features of colour at strides 4, 8, 16."""
        raise NotImplementedError

    def metres(self, views: Views, colour: Colour, bounds: Bounds) -> Tensor:
        """Return depth (B, 1, H, W) in metres."""
        return bounds.denormalise(self(views, colour))

    def losses(self, views: Views, colour: Colour, batch: Batch, paint: Tensor) -> Losses:
        """Return losses of a batch, of which ``total`` is minimised; ``paint`` (B, 1, H, W) says what counts most."""
        return painted_loss(batch.relative_error(self(views, colour)), paint, batch.gt_known, self.elsewhere)


def seen(views: Views) -> tuple[Tensor, Tensor]:
    """Return what every idea but colour alone is shown: DITR's conditioning image, and a fill of *all* readings.

    Returns:
        the image (B, 9, H, W), and depth (B, 1, H, W), normalised, dense.
    """
    image, filled, _ = condition(views.rgb, views.depth_n, views.valid, views.region, views.guide, evidence=True)
    return image, filled + image[:, OFFSET : OFFSET + 1]


def painted_loss(error: Tensor, paint: Tensor, known: Tensor, elsewhere: float = ELSEWHERE) -> Losses:
    """Score relative errors (B, 1, H, W) as the detail network's recipe does, L1 and RMS of a view together.

    Args:
        error: ln(predicted / true).
        paint: 0/1, the pixels that must be painted.
        known: 0/1, where the truth is known.
        elsewhere: weight of other pixels.
    """
    weight = (paint + elsewhere).clamp(max=1) * known
    count = weight.sum(dim=(1, 2, 3)).clamp(min=1)
    l1 = ((error.abs() * weight).sum(dim=(1, 2, 3)) / count).mean()
    rms = ((error.square() * weight).sum(dim=(1, 2, 3)) / count + 1e-8).sqrt().mean()
    return {"total": 10 * (l1 + rms), "l1": l1, "rms": rms}


class Regression(Idea):
    """DFNet's idea: one network corrects the readings and fills the holes, in one pass."""

    def __init__(self, config: Config):
        super().__init__(config)
        self.net = PixelUNet(len(CHANNELS), 1, self.colour_channels)

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Add a residual to the readings and their fill."""
        image, everything = seen(views)
        return everything + self.net(cl(image), colour)


class RgbOnly(Idea):
    """DenseDepth's idea: colour alone says how far things are. Readings only give the frame of reference.

    Args:
        config: sizes.
        aligned: scale and shift what was painted to the readings outside the region, MiDaS's idea.
    """

    elsewhere = 0.5  # an alignment looks at what is outside, so that must be right, too

    def __init__(self, config: Config, aligned: bool = False):
        super().__init__(config)
        self.aligned = aligned
        self.net = PixelUNet(3, 1, self.colour_channels)

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Predict depth from colour."""
        return self.net(cl(views.rgb), colour)

    def metres(self, views: Views, colour: Colour, bounds: Bounds) -> Tensor:
        """Return depth in metres, aligned in metres if so asked."""
        painted = super().metres(views, colour, bounds)
        if not self.aligned:
            return painted
        pairs = zip(painted[:, 0].numpy(), trusted_metres(views, bounds), strict=True)
        return torch.from_numpy(np.stack([fitted(own, readings) for own, readings in pairs]))[:, None]


class NormalsOptimisation(Idea):
    """DeepCompletion's and ClearGrasp's idea: predict orientation and occlusion edges, then solve for depth.

    Orientation is the gradient of log depth on the image (see ``peers.gradient_solve``). Readings inside the region
    are dropped.
    """

    def __init__(self, config: Config):
        super().__init__(config)
        self.net = PixelUNet(len(CHANNELS), 3, self.colour_channels)

    def predicted(self, views: Views, colour: Colour) -> Tensor:
        """Return (B, 3, H, W): gradients to the right and downwards, and the logit of an edge."""
        return self.net(cl(seen(views)[0]), colour)

    def metres(self, views: Views, colour: Colour, bounds: Bounds) -> Tensor:
        """Solve view by view."""
        out = self.predicted(views, colour)
        solved = []
        for maps, readings in zip(out, trusted_metres(views, bounds), strict=True):
            solved.append(solve(readings, maps[:2].numpy(), torch.sigmoid(maps[2]).numpy()))
        return torch.from_numpy(np.stack(solved))[:, None]

    def losses(self, views: Views, colour: Colour, batch: Batch, paint: Tensor) -> Losses:
        """Score predicted gradients of log depth (L1, off edges) and edges (cross-entropy)."""
        return orientation_loss(self.predicted(views, colour), batch, paint)


class TwoStreamConfidence(Idea):
    """SwinDRNet's idea: a prediction and the sensor, each with a learnt confidence, blended by it."""

    def __init__(self, config: Config):
        super().__init__(config)
        self.net = PixelUNet(len(CHANNELS), 3, self.colour_channels)

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Blend."""
        image, everything = seen(views)
        return blend(self.net(cl(image), colour), everything)


def blend(out: Tensor, sensor: Tensor) -> Tensor:
    """Return a prediction and the sensor (B, 1, H, W), weighted by softmax confidences.

    Args:
        out: (B, 3, H, W): the prediction, its confidence, the sensor's.
        sensor: the readings and their fill.
    """
    own, *confidences = out.split(1, dim=1)
    weights = torch.cat(confidences, dim=1).softmax(dim=1)  # (B, 2, H, W)
    return weights[:, :1] * own + weights[:, 1:] * sensor


class ImplicitRays(Idea):
    """LIDF's idea: an implicit function of a ray's features and a point on the ray says whether the ray ends there.

    LIDF asks the voxels that a ray crosses and that hold readings. Here every ray asks the same few points of the
    frame's range, a prior draws it towards the fill of the readings, and each point may be moved by up to a step.
    """

    POINTS = 9
    REACH = 1.6  # of the points, in network units: the bounds lie at -1 and 1
    HIDDEN = 12

    def __init__(self, config: Config):
        super().__init__(config)
        self.net = PixelUNet(len(CHANNELS), 1, self.colour_channels)
        self.net.out = nn.Conv2d(self.net.out.in_channels, self.HIDDEN, 1)
        self.at = nn.Parameter(0.1 * torch.randn(self.POINTS, self.HIDDEN))  # a point of the ray, learnt
        self.near = nn.Parameter(torch.zeros(self.HIDDEN))  # how far it lies from the fill
        self.ends = nn.Conv2d(self.HIDDEN, 8, 1)  # of the 2x2 rays of a cell: a logit and an offset each
        self.register_buffer("points", torch.linspace(-self.REACH, self.REACH, self.POINTS), persistent=False)
        nn.init.zeros_(self.ends.weight)
        nn.init.zeros_(self.ends.bias)

    def ask(self, views: Views, colour: Colour) -> tuple[Tensor, Tensor]:
        """Return logits of where each ray ends and the depth of its points, (B, POINTS, H, W) each."""
        image, everything = seen(views)
        rays = self.net.out(self.net.body(cl(image), colour))  # (B, C, h, w), h = H/2
        away = (self.points[None, :, None, None] - F.avg_pool2d(everything, 2)).abs()  # (B, K, h, w)
        hidden = (
            rays[:, None] + self.at[None, :, :, None, None] + away[:, :, None] * self.near[None, None, :, None, None]
        )
        out = self.ends(F.silu(hidden).flatten(0, 1))  # (B, K, C, h, w) -> (B K, 8, h, w)
        logits, offsets = F.pixel_shuffle(out, 2).unflatten(0, (len(image), -1)).unbind(dim=2)  # (B, K, H, W) each
        step = 2 * self.REACH / (self.POINTS - 1)
        depth = self.points[None, :, None, None] + step * torch.tanh(offsets)
        prior = (self.points[None, :, None, None] - everything).abs() / step  # (B, K, H, W)
        return logits - 2 * prior, depth

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Return the expected end of each ray."""
        logits, depth = self.ask(views, colour)
        return (logits.softmax(dim=1) * depth).sum(dim=1, keepdim=True)

    def losses(self, views: Views, colour: Colour, batch: Batch, paint: Tensor) -> Losses:
        """Score the expected end, and the class of the point nearest to the truth."""
        logits, depth = self.ask(views, colour)
        painted = (logits.softmax(dim=1) * depth).sum(dim=1, keepdim=True)
        losses = painted_loss(batch.relative_error(painted), paint, batch.gt_known, self.elsewhere)
        nearest = (self.points[None, :, None, None] - batch.gt_n).abs().argmin(dim=1)  # (B, H, W)
        weight = ((paint + ELSEWHERE).clamp(max=1) * batch.gt_known)[:, 0]
        ends = (F.cross_entropy(logits, nearest, reduction="none") * weight).sum() / weight.sum().clamp(min=1)
        return {**losses, "total": losses["total"] + 0.2 * ends, "ends": ends}


class PointCompletion(Idea):
    """TranspareNet's idea: lift the readings to points, complete the cloud, project it, then refine with colour.

    A point is (x, y, depth) in network units: picture coordinates from -1 to 1 and normalised log depth, so no camera
    is needed. A PointNet describes the cloud; a folding network moves a grid of points, begun at the fill of the
    trusted readings, to where surface should be; nearer points hide farther ones when they are projected.
    """

    POINTS = 1024
    CELL = 4  # pixels a side of a grid point
    FEATURES = 128
    SHIFT = 0.1  # how far a point may move across the picture

    def __init__(self, config: Config):
        super().__init__(config)
        self.describe = perceptron(4, 64, self.FEATURES)
        self.fold = perceptron(5 + self.FEATURES, 64, 64, 3)
        nn.init.zeros_(self.fold[-1].weight)
        nn.init.zeros_(self.fold[-1].bias)
        self.net = PixelUNet(len(CHANNELS) + 1, 1, self.colour_channels)

    def cloud(self, views: Views) -> Tensor:
        """Lift readings: (B, 4, POINTS) of x, y, depth and whether it lies in the region; evenly chosen, repeated."""
        height, width = views.valid.shape[2:]
        points = []
        for depth_n, valid, region in zip(views.depth_n[:, 0], views.valid[:, 0], views.region[:, 0], strict=True):
            at = torch.nonzero(valid.flatten() > 0)[:, 0]
            at = at[torch.arange(self.POINTS) * len(at) // self.POINTS] if len(at) else torch.zeros(self.POINTS).long()
            x, y = (at % width) * (2 / width) - 1, (at // width) * (2 / height) - 1
            points.append(torch.stack([x, y, depth_n.flatten()[at], region.flatten()[at]]))
        return torch.stack(points)

    def complete(self, views: Views) -> Tensor:
        """Return the completed cloud (B, 3, N): x, y, depth of the points of the grid, moved."""
        _, filled, _ = condition(views.rgb, views.depth_n, views.valid, views.region, views.guide, evidence=True)
        _, everything = seen(views)
        depth, all_depth, region = (F.avg_pool2d(m, self.CELL) for m in (filled, everything, views.region))
        count, _, h, w = depth.shape
        y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
        place = torch.stack([x, y])[None].expand(count, -1, -1, -1)
        grid = torch.cat([place, depth, all_depth, region], dim=1).flatten(2)  # (B, 5, N)
        whole = self.describe(self.cloud(views)).amax(dim=2, keepdim=True)  # (B, F, 1): order does not matter
        moved = self.fold(torch.cat([grid, whole.expand(-1, -1, grid.shape[2])], dim=1))
        across = self.SHIFT * torch.tanh(moved[:, :2])
        return torch.cat([grid[:, :2] + across, grid[:, 2:3] + moved[:, 2:]], dim=1)

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Complete, project, refine."""
        return self.refine(views, colour, self.projected(views, self.complete(views)))

    def projected(self, views: Views, points: Tensor) -> Tensor:
        """Return depth (B, 1, H, W) of a completed cloud, dense."""
        h, w = (n // self.CELL for n in views.valid.shape[2:])
        depth, weight = project(points, (h, w))
        dense = fill(depth, (weight > 0.05).float())
        return F.interpolate(dense, scale_factor=float(self.CELL), mode="bilinear", align_corners=False)

    def refine(self, views: Views, colour: Colour, projected: Tensor) -> Tensor:
        """Correct a projected cloud (B, 1, H, W) with colour."""
        image, _ = seen(views)
        return projected + self.net(cl(torch.cat([image, projected], dim=1)), colour)

    def losses(self, views: Views, colour: Colour, batch: Batch, paint: Tensor) -> Losses:
        """Score the refined depth, the projected cloud, and the cloud against that of the truth (Chamfer)."""
        points = self.complete(views)
        projected = self.projected(views, points)
        refined = self.refine(views, colour, projected)
        losses = painted_loss(batch.relative_error(refined), paint, batch.gt_known, self.elsewhere)
        before = painted_loss(batch.relative_error(projected), paint, batch.gt_known, self.elsewhere)["total"]
        truth = F.avg_pool2d(fill(batch.gt_n, batch.gt_known), self.CELL).flatten(2)  # (B, 1, N)
        h, w = (n // self.CELL for n in batch.gt_n.shape[2:])
        y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
        place = torch.stack([x, y]).flatten(1)[None].expand(len(truth), -1, -1)
        distance = chamfer(points, torch.cat([place, truth], dim=1))
        total = losses["total"] + 0.3 * before + distance
        return {**losses, "total": total, "projected": before, "chamfer": distance}


def project(points: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Splat points (B, 3, N) of x, y in [-1, 1] and depth onto a grid (h, w), nearer ones counting more.

    Returns:
        depth (B, 1, h, w), 0 where no point falls, and how much fell there (B, 1, h, w).
    """
    h, w = size
    count = len(points)
    column, row = (points[:, 0] + 1) * (w - 1) / 2, (points[:, 1] + 1) * (h - 1) / 2  # (B, N) each
    nearness = torch.exp(-4 * points[:, 2].clamp(-3, 3))
    sums = points.new_zeros(3, count, h * w)
    for dy in (0, 1):
        for dx in (0, 1):
            c, r = column.floor() + dx, row.floor() + dy
            share = (1 - (column - c).abs()).clamp(min=0) * (1 - (row - r).abs()).clamp(min=0)
            share = share * ((c >= 0) & (c < w) & (r >= 0) & (r < h))
            at = (r.clamp(0, h - 1) * w + c.clamp(0, w - 1)).long()
            counted = share * nearness
            parts = torch.stack([counted * points[:, 2], counted, share])
            sums = sums.scatter_add(2, at[None].expand(3, -1, -1), parts)
    depth, weight, share = sums.unflatten(2, (h, w)).unbind(0)
    return (depth / weight.clamp(min=1e-6))[:, None], share[:, None]


def chamfer(points: Tensor, truth: Tensor) -> Tensor:
    """Return the mean distance of points (B, 3, N) from the nearest true one and the reverse, of every sixth point."""
    there = torch.cdist(points[..., ::6].transpose(1, 2), truth.transpose(1, 2)).amin(dim=2)
    back = torch.cdist(truth[..., ::6].transpose(1, 2), points.transpose(1, 2)).amin(dim=2)
    return there.mean() + back.mean()


class Adversarial(Idea):
    """DepthGrasp's idea: a critic learns to tell painted depth from true depth; the painter learns to deceive it.

    The painter is :class:`Regression`'s. Painted depth stands in the true depth of what is around it, so that nothing
    but the painting can give it away. Hinge losses; the painter still has its errors to lower.
    """

    WEIGHT = 0.3  # of what the critic says

    def __init__(self, config: Config):
        super().__init__(config)
        self.painter = Regression(config)
        self.critic = Critic()

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Paint; the critic is needed for training alone."""
        return self.painter(views, colour)

    def losses(self, views: Views, colour: Colour, batch: Batch, paint: Tensor) -> Losses:
        """Score painter and critic in one: the critic's weights are held while the painter is scored by it."""
        painted = self(views, colour)
        losses = painted_loss(batch.relative_error(painted), paint, batch.gt_known, self.elsewhere)
        true = fill(batch.gt_n, batch.gt_known)
        shown = torch.where(paint > 0, painted, true)
        held = {name: p.detach() for name, p in self.critic.named_parameters()}
        deceived = -functional_call(self.critic, held, (views.rgb, shown)).mean()
        on_true, on_painted = self.critic(views.rgb, true), self.critic(views.rgb, shown.detach())
        critic = F.relu(1 - on_true).mean() + F.relu(1 + on_painted).mean()
        total = losses["total"] + self.WEIGHT * deceived + critic
        return {**losses, "total": total, "deceived": deceived, "critic": critic}


class SelfSupervised(Idea):
    """SRD's idea, self-supervision, with one camera: depth from colour, taught and scaled by the sensor's readings.

    SRD learns from neighbouring frames; a single RGB-D frame has its readings instead. No true depth is asked for. The
    prediction is scaled and shifted to the readings outside the region (least squares); what it then differs from them
    by is the loss, beside a smoothness that yields at edges of the picture. In the claimed region nothing teaches it;
    where the claim is too small readings on glass do, and training lets the sensor read some of these as they are.
    """

    SMOOTH = 0.3

    def __init__(self, config: Config):
        super().__init__(config)
        self.net = PixelUNet(3, 1, self.colour_channels)

    def forward(self, views: Views, colour: Colour) -> Tensor:
        """Predict from colour, then scale and shift."""
        trusted = views.valid * (1 - views.region)
        return align(self.net(cl(views.rgb), colour), views.depth_n, trusted)

    def losses(self, views: Views, colour: Colour, batch: Batch, paint: Tensor) -> Losses:
        """Score against the readings that are trusted, and by smoothness."""
        own = self(views, colour)
        trusted = views.valid * (1 - views.region)
        l1 = ((own - views.depth_n).abs() * trusted).sum() / trusted.sum().clamp(min=1)
        rough = torch.zeros(())
        for dim in (2, 3):
            step = own.diff(dim=dim).abs()
            rough = rough + (step * torch.exp(-8 * views.rgb.diff(dim=dim).abs().mean(dim=1, keepdim=True))).mean()
        return {"total": l1 + self.SMOOTH * rough, "readings": l1, "rough": rough}


def align(own: Tensor, readings: Tensor, trusted: Tensor) -> Tensor:
    """Return a * own + b (B, 1, H, W), with the least-squares a, b of each view over trusted readings.

    A ridge keeps a near 1 where the prediction is flat; a view without a trusted reading stays as it is.
    """
    count = trusted.sum(dim=(1, 2, 3), keepdim=True)
    n = count.clamp(min=1)
    mean_own = (own * trusted).sum(dim=(1, 2, 3), keepdim=True) / n
    mean_read = (readings * trusted).sum(dim=(1, 2, 3), keepdim=True) / n
    centred = own - mean_own
    ridge = 1e-3
    both = (centred * (readings - mean_read) * trusted).sum(dim=(1, 2, 3), keepdim=True) / n
    square = (centred.square() * trusted).sum(dim=(1, 2, 3), keepdim=True) / n
    scale = (both + ridge) / (square + ridge)
    return torch.where(count > 0, scale * centred + mean_read, own)


def trusted_metres(views: Views, bounds: Bounds) -> np.ndarray:
    """Return the readings outside the region (B, H, W) in metres, 0 elsewhere; all readings where none is outside."""
    outside = views.valid * (1 - views.region)
    some = outside.sum(dim=(1, 2, 3), keepdim=True) > 0
    kept = torch.where(some, outside, views.valid)
    return (bounds.denormalise(views.depth_n) * kept)[:, 0].numpy()


IDEAS: dict[str, type[Idea]] = {
    "regression": Regression,
    "rgb_only": RgbOnly,
    "normals_optimisation": NormalsOptimisation,
    "two_stream_confidence": TwoStreamConfidence,
    "implicit_rays": ImplicitRays,
    "point_completion": PointCompletion,
    "adversarial": Adversarial,
    "self_supervised": SelfSupervised,
}


def build_idea(name: str, config: Config) -> Idea:
    """Return the untrained network of an idea.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in IDEAS:
        raise ValueError(f"unknown peer {name!r}; choose one of {', '.join(IDEAS)}")
    return IDEAS[name](config)
