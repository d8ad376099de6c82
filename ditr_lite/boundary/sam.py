"""Boundaries as the paper finds them: the outlines of the masks that SAM (Segment Anything) sees in an image.

Paper: Sec. IV-C, "ViT-L SAM model respectively on RGB images and depth images". From ``transformers`` only the network
is taken; asking it about a grid of points, weeding out doubles, and turning masks into a map are written out here,
because how a set of masks becomes a boundary map is what the paper leaves open. Kirillov et al., "Segment Anything",
ICCV 2023, Sec. 5 and App. B, is the source of the thresholds.
"""

import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..conditioning import depth_bounds
from ..store import fingerprint
from .classical import is_depth, spread_readings

CHECKPOINT = Path("outputs/sam")  # where a checkpoint is looked for when no path is given
MEAN, STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)  # of SAM's training images, 0 to 255
WHERE = (
    "put SAM's Hugging Face checkpoint (facebook/sam-vit-large for the paper's ViT-L; the files config.json and "
    "model.safetensors) into a folder, and name that folder: --sam DIR, boundary_path=DIR, or get_backend('sam', DIR)"
)


def point_grid(per_side: int) -> np.ndarray:
    """Return (per_side^2, 2) float32 points (x, y) in the unit square, the centres of as many equal squares."""
    at = (np.arange(per_side, dtype=np.float32) + 0.5) / per_side
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def stability(logits: Tensor, offset: float = 1.0) -> Tensor:
    """Return (N,): how little masks change when their threshold moves by ``offset`` both ways, as an overlap.

    Args:
        logits: (N, h, w); a mask is where they exceed 0.
        offset: in logits.
    """
    small, large = ((logits > cut).sum(dim=(1, 2)).float() for cut in (offset, -offset))
    return small / large.clamp(min=1)  # the small one lies inside the large one


def suppress(masks: np.ndarray, scores: np.ndarray, max_overlap: float = 0.7) -> list[int]:
    """Return the indices of the masks that survive non-maximum suppression, best first.

    The best mask is kept, all that overlap it (intersection over union) by more than ``max_overlap`` are dropped, and
    so on with the rest. Points on one object give the same mask many times; one is enough.

    Args:
        masks: (N, H, W) bool.
        scores: (N,), higher is better; of equals the first is taken.
        max_overlap: 0 to 1.

    Raises:
        ValueError: when there is not one score per mask.
    """
    if masks.ndim != 3 or scores.shape != masks.shape[:1]:
        raise ValueError(f"expected masks (N, H, W) and scores (N,), got {masks.shape} and {scores.shape}")
    flat = masks.reshape(len(masks), masks.shape[1] * masks.shape[2])
    area, left, kept = flat.sum(axis=1), np.argsort(-scores, kind="stable"), []
    while left.size:
        best, left = left[0], left[1:]
        kept.append(int(best))
        both = (flat[left] & flat[best]).sum(axis=1)
        left = left[both <= max_overlap * (area[left] + area[best] - both)]
    return kept


def outlines(masks: np.ndarray) -> np.ndarray:
    """Turn a set of masks into one boundary map: (N, H, W) bool -> (H, W) bool.

    Rule: a pixel belongs to the smallest mask that holds it (small masks are objects and parts, large ones what lies
    behind), or to none. Where two neighbours (of 4) belong to different masks, the one whose mask is smaller is marked,
    and none counts as larger than any. So lines are one pixel wide and lie on the object, and the picture's frame is
    no boundary.

    Raises:
        ValueError: for anything but (N, H, W) bool.
    """
    if masks.ndim != 3 or masks.dtype != bool:
        raise ValueError(f"expected masks (N, H, W) bool, got {masks.shape} {masks.dtype}")
    order = np.argsort(-masks.sum(axis=(1, 2)), kind="stable")  # largest first
    rank = np.zeros(masks.shape[1:], np.int64)  # 0: no mask, then 1 the largest, ...
    for k, i in enumerate(order, start=1):
        rank[masks[i]] = k
    edge = np.zeros(rank.shape, bool)
    edge[:, :-1] |= rank[:, :-1] > rank[:, 1:]
    edge[:, 1:] |= rank[:, 1:] > rank[:, :-1]
    edge[:-1] |= rank[:-1] > rank[1:]
    edge[1:] |= rank[1:] > rank[:-1]
    return edge


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """Return depth as a grey picture (H, W, 3) uint8, near bright, for a network that knows photographs.

    Bounds come from the raw readings alone (``conditioning.depth_bounds``); a missing pixel takes the grey of its
    nearest reading, so that a hole does not look like an object.

    Args:
        depth: (H, W) float metres, 0 = missing, with at least one reading.

    Raises:
        ValueError: when there is no reading.
    """
    level = (1 - depth_bounds(depth).normalise(spread_readings(depth))) / 2  # -1 (near) -> 1, 1 (far) -> 0
    return np.repeat(np.rint(255 * np.clip(level, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)


class SamBoundary:
    """A SAM network as a backend.

    Args:
        model: ``transformers.SamModel``.
        points: of the grid, per side.
        min_score: masks whose overlap with the truth the network itself expects to be lower are dropped.
        min_stability: see :func:`stability`.
        max_overlap: see :func:`suppress`.
        batch: points asked about at a time.
    """

    def __init__(
        self,
        model: nn.Module,
        points: int = 32,
        min_score: float = 0.88,
        min_stability: float = 0.95,
        max_overlap: float = 0.7,
        batch: int = 64,
    ):
        if min(points, batch) < 1:
            raise ValueError(f"expected at least one point and a batch of one, got {points} and {batch}")
        self.model, self.points, self.batch = model.eval().requires_grad_(False), points, batch
        self.min_score, self.min_stability, self.max_overlap = min_score, min_stability, max_overlap

    @property
    def fingerprint(self) -> str:
        """Checksum of all that the maps depend on, for caches."""
        return fingerprint(self.model, self.points, self.min_score, self.min_stability, self.max_overlap)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the (H, W) bool boundary map of an image or of a depth map (see ``boundary.Backend``).

        Raises:
            ValueError: for anything else.
        """
        image = np.asarray(image)
        if is_depth(image):
            if not (image > 0).any():
                return np.zeros(image.shape, bool)
            image = depth_picture(image.astype(np.float32))
        return outlines(self.masks(image))

    @torch.no_grad()
    def masks(self, rgb: np.ndarray) -> np.ndarray:
        """Return what the network sees in (H, W, 3) uint8: (N, H, W) bool, the surest first."""
        (height, width), side = rgb.shape[:2], max(rgb.shape[:2])
        pixels, (rows, columns) = self._pixels(rgb)
        embedding = self.model.get_image_embeddings(pixels)
        points = torch.from_numpy(point_grid(self.points)) * torch.tensor([columns, rows], dtype=torch.float32)
        found, scores = [], []
        for some in points.split(self.batch):
            out = self.model(image_embeddings=embedding, input_points=some[None, :, None], multimask_output=True)
            logits, score = out.pred_masks[0].flatten(0, 1), out.iou_scores[0].flatten()  # three masks a point
            inside = self._inside(logits, rows, columns)
            sure = (score >= self.min_score) & (stability(inside) >= self.min_stability)
            sure &= (inside > 0).any(dim=2).any(dim=1)
            found.append(logits[sure])
            scores.append(score[sure])
        logits, score = torch.cat(found), torch.cat(scores)
        inside = self._inside(logits, rows, columns)
        kept = suppress((inside > 0).numpy(), score.numpy(), self.max_overlap)
        # the square of the logits is the square of the picture's longer side: enlarge it, then cut the padding off
        large = [F.interpolate(logits[k][None, None], size=(side, side), mode="bilinear")[0, 0] > 0 for k in kept]
        return np.array([m[:height, :width].numpy() for m in large], bool).reshape(-1, height, width)

    def _inside(self, logits: Tensor, rows: int, columns: int) -> Tensor:
        """Cut the padding off masks (N, h, h), which are coarser than the picture that the network saw."""
        share = logits.shape[-1] / self.model.config.vision_config.image_size
        return logits[:, : max(1, round(rows * share)), : max(1, round(columns * share))]

    def _pixels(self, rgb: np.ndarray) -> tuple[Tensor, tuple[int, int]]:
        """Return the picture as SAM wants it, (1, 3, S, S), and the (rows, columns) of it that are not padding."""
        size = self.model.config.vision_config.image_size
        scale = size / max(rgb.shape[:2])
        rows, columns = (max(1, round(n * scale)) for n in rgb.shape[:2])
        large = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_LINEAR).astype(np.float32)
        large = (large - np.float32(MEAN)) / np.float32(STD)
        pixels = torch.from_numpy(large).permute(2, 0, 1)[None]
        return F.pad(pixels, (0, size - columns, 0, size - rows)), (rows, columns)


def load(path: Path | str | None = None) -> SamBoundary:
    """Return the backend with the checkpoint in the folder ``path`` (None: ``outputs/sam``); nothing is downloaded.

    Raises:
        ValueError: when there is no SAM checkpoint there, or it is incomplete.
        ImportError: without transformers.
    """
    folder = Path(path or CHECKPOINT)
    if not (folder / "config.json").is_file():
        raise ValueError(f"no SAM checkpoint in {folder}: {WHERE}")
    try:
        kind = json.loads((folder / "config.json").read_text(encoding="utf-8")).get("model_type")
    except (ValueError, AttributeError):
        kind = None
    if kind != "sam":
        raise ValueError(f"{folder / 'config.json'} describes model_type {kind!r}, expected 'sam': {WHERE}")
    if importlib.util.find_spec("transformers") is None:
        raise ImportError("the backend 'sam' needs transformers: pip install -e '.[sam]'")
    from transformers import SamModel

    try:
        # safetensors only: other formats can run code; local only: a wrong path must not become a download
        model, info = SamModel.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except (OSError, RuntimeError) as error:
        raise ValueError(f"cannot load SAM from {folder} ({str(error).splitlines()[0]}): {WHERE}") from None
    if info["missing_keys"]:
        raise ValueError(f"the SAM checkpoint in {folder} lacks {len(info['missing_keys'])} tensors: {WHERE}")
    return SamBoundary(model)
