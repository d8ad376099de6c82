"""Batches: views of scenes in network units, with the guides of the two branches."""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from ..boundary import M_DA, M_RGB, Backend, boundary_maps
from ..conditioning import Bounds, depth_bounds, to_tensor
from ..data import lossy
from ..units import without_strays
from .loop import WHOLE, Share
from .scenes import Pool, Scenes
from .views import View, disturb, frame_view, mix_views, read_truly, window_view

READ_TRULY = 0.4  # of the windows, in which the sensor reads parts of the glass as it is


@dataclass(frozen=True)
class Batch:
    """Tensors of B views in network units: rgb (B, 3, H, W) in [-1, 1], all others (B, 1, H, W) unless said."""

    rgb: Tensor
    depth_n: Tensor  # raw, 0 where missing or hidden
    valid: Tensor
    gt_n: Tensor  # ground truth, 0 where unknown
    gt_known: Tensor
    material: Tensor  # (B, H, W) int64
    region: Tensor
    bounds: Bounds  # tensors (B, 1, 1, 1)
    guide_rgb: Tensor | None
    guide_da: Tensor | None

    def to(self, device: torch.device | str) -> "Batch":
        """Return the batch on a device."""
        moved = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "bounds"}
        moved = {name: None if tensor is None else tensor.to(device) for name, tensor in moved.items()}
        return Batch(**moved, bounds=Bounds(self.bounds.low.to(device), self.bounds.high.to(device)))

    @property
    def truth_m(self) -> Tensor:
        """Ground truth (B, 1, H, W) in metres, 0 where unknown."""
        return self.bounds.denormalise(self.gt_n) * self.gt_known

    def relative_error(self, depth_n: Tensor) -> Tensor:
        """Return ln(predicted / true), (B, 1, H, W): the error as a share of the depth; 0 where the truth is unknown.

        Metres would let rooms outweigh table tops, and a share of the frame's middle the wall behind the table.
        """
        return self.relative_error_m(self.bounds.denormalise(depth_n))

    def relative_error_m(self, depth_m: Tensor) -> Tensor:
        """Do what :meth:`relative_error` does with a prediction (B, 1, H, W) in metres, above 0."""
        true = self.bounds.denormalise(self.gt_n)
        return torch.where(self.gt_known > 0, (depth_m / true).log(), 0.0)


def batch_of(views: list[View], backend: Backend | None = None, around: bool = False) -> Batch:
    """Normalise views and stack them.

    Args:
        views: of one size.
        backend: finds the guides; None leaves them out.
        around: take the bounds from readings outside the region, as windows do.
    """
    rows = {name: [] for name in ("depth_n", "valid", "gt_n", "gt_known", "region", "guide_rgb", "guide_da")}
    lows, highs = [], []
    for view in views:
        depth = without_strays(view.depth)
        bounds = depth_bounds(depth if depth.any() else np.ones_like(depth), ~view.region if around else None)
        lows.append(bounds.low)
        highs.append(bounds.high)
        rows["depth_n"].append(bounds.normalise(depth))
        rows["valid"].append(depth > 0)
        rows["gt_n"].append(bounds.normalise(view.depth_gt))
        rows["gt_known"].append(view.depth_gt > 0)
        rows["region"].append(view.region)
        if backend is not None:
            maps = boundary_maps(view.rgb, depth, backend)
            rows["guide_rgb"].append(maps[M_RGB])
            rows["guide_da"].append(maps[M_DA])
    stacked = {k: torch.from_numpy(np.stack(v).astype(np.float32))[:, None] for k, v in rows.items() if v}
    column = [torch.tensor(v, dtype=torch.float32).view(-1, 1, 1, 1) for v in (lows, highs)]
    return Batch(
        rgb=to_tensor(np.stack([v.rgb for v in views])),
        material=torch.from_numpy(np.stack([v.material for v in views]).astype(np.int64)),
        bounds=Bounds(*column),
        guide_rgb=stacked.pop("guide_rgb", None),
        guide_da=stacked.pop("guide_da", None),
        **stacked,
    )


def draw_frames(
    pool: Pool,
    count: int,
    size: tuple[int, int],
    rng: np.random.Generator,
    backend: Backend | None = None,
    still: bool = False,
    mixed: float = 0.0,
    share: Share = WHOLE,
) -> Batch:
    """Draw whole frames, moved, turned and disturbed.

    Args:
        pool: of scenes.
        count: of frames.
        size: (H, W) of the views.
        rng: everything random comes from it, so a step can be drawn again when training resumes.
        backend: finds the guides; None leaves them out.
        still: do not move or turn them.
        mixed: share of the frames of which a part is replaced by another.
        share: of the batch, the part that is drawn and returned.
    """
    views = []
    for own in share.take(rng.spawn(count)):  # a generator for each frame: a share draws only its own frames
        view = frame_view(*pool.pick(own), size, own, still)
        if mixed and own.random() < mixed:
            view = mix_views(view, frame_view(*pool.pick(own), size, own, still), own)
        views.append(disturb(view, own))
    return batch_of(views, backend)


def draw_windows(
    pool: Pool,
    count: int,
    side: int,
    rng: np.random.Generator,
    backend: Backend | None = None,
    share: Share = WHOLE,
) -> Batch:
    """Draw windows around what the optical branch must paint, a third of them mistaken; see :func:`draw_frames`."""
    views = []
    for own in share.take(rng.spawn(count)):
        view = window_view(*pool.pick(own), (side, side), own)
        if own.random() < READ_TRULY:
            view = read_truly(view, own)
        views.append(disturb(view, own))
    return batch_of(views, backend, around=True)


def frames_in_order(
    scenes: Scenes, size: tuple[int, int], count: int = 8, backend: Backend | None = None
) -> Iterator[Batch]:
    """Yield all scenes as whole frames, ``count`` at a time, as they are."""
    for start in range(0, len(scenes), count):
        views = [frame_view(scenes, i, size, None) for i in range(start, min(start + count, len(scenes)))]
        yield batch_of(views, backend)


def steps_of_an_epoch(scenes: int, count: int) -> int:
    """Return in how many steps of ``count`` frames every scene is seen once."""
    return -(-scenes // count)


def epoch_frames(
    pool: Pool,
    size: tuple[int, int],
    count: int,
    seed: int,
    backend: Backend | None,
    step: int,
    share: Share = WHOLE,
) -> Batch:
    """Return what step ``step`` of training in epochs sees: whole frames, moved, turned and disturbed.

    In an epoch every scene is seen once, in random order; its last batch may be smaller, unless it must be shared:
    then it is filled up from the epoch's beginning.
    """
    epoch, place = divmod(step, steps_of_an_epoch(len(pool), count))
    order = np.random.default_rng([seed, epoch]).permutation(len(pool))
    if share.of > 1:
        order = np.resize(order, count * steps_of_an_epoch(len(pool), count))
    chosen = order[place * count : (place + 1) * count]
    generators = np.random.default_rng([seed, epoch, place]).spawn(len(chosen))
    views = []
    for i, own in share.take(list(zip(chosen, generators, strict=True))):
        views.append(disturb(frame_view(*pool[int(i)], size, own), own))
    return batch_of(views, backend)


def scenes_with_glass(scenes: Scenes) -> list[int]:
    """Return which scenes hold glass or metal."""
    return [i for i in range(len(scenes)) if lossy(scenes.material[i]).any()]


def windows_in_order(scenes: Scenes, side: int, count: int = 8, backend: Backend | None = None) -> Iterator[Batch]:
    """Yield a window of every scene that holds glass or metal, with its true region as far off as training shows it.

    The same ones every time; :func:`views.grow` says how far.
    """
    rng = np.random.default_rng(1)
    glass = scenes_with_glass(scenes)
    for start in range(0, len(glass), count):
        views = [window_view(scenes, i, (side, side), rng, mistaken=0.0) for i in glass[start : start + count]]
        yield batch_of(views, backend, around=True)
