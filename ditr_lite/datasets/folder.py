"""Any camera: a folder of your own frames, colour and depth under the same names."""

from pathlib import Path

import numpy as np

from ..data import OPAQUE, TRANSPARENT, Sample
from ..files import read_depth, read_intrinsics, read_mask, read_rgb
from .base import FrameFolder

COLOUR, DEPTH, CAMERAS = (".png", ".jpg", ".jpeg"), (".png", ".npy", ".exr"), ("intrinsics.txt", "intrinsics.npy")


class Folder(FrameFolder):
    """Frames of any camera: ``rgb/NAME``, ``depth/NAME``, and, where they are known, ``region/``, ``truth/``, a camera.

    Args:
        root: the folder.
        split: None; a folder of one's own has no splits.
        depth_scale: metres per unit of whole-number depth (0.001: millimetres).
    """

    layout = "rgb/NAME.{png,jpg}, depth/NAME.{png,npy,exr}; may have region/NAME.png, truth/NAME.*, intrinsics.txt"
    frame = tuple(f"depth/*{ending}" for ending in DEPTH)
    protocol = "Depth aligned to the colour picture, 0 = missing. Without truth/ there is nothing to score: look."

    def __init__(self, root: Path | str, split: str | None = None, depth_scale: float = 0.001):
        self.depth_scale = depth_scale
        super().__init__(root, split)

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        folder, known = stem.parents[1], stem.stem
        rgb = read_rgb(_one(folder / "rgb", known, COLOUR))
        mask, truth = folder / "region" / f"{known}.png", _find(folder / "truth", known, DEPTH)
        region = read_mask(mask) if mask.is_file() else None
        camera = next((folder / c for c in CAMERAS if (folder / c).is_file()), None)
        return Sample(
            name=name,
            rgb=rgb,
            depth=read_depth(stem, self.depth_scale, allow_empty=True),
            depth_gt=read_depth(truth, self.depth_scale) if truth else None,
            region=region,
            camera=read_intrinsics(camera, rgb.shape[:2]) if camera else None,
            material=None if region is None else np.where(region, TRANSPARENT, OPAQUE).astype(np.uint8),
            meta={"dataset": "folder"},
        )


def _find(folder: Path, name: str, endings: tuple[str, ...]) -> Path | None:
    return next((folder / (name + ending) for ending in endings if (folder / (name + ending)).is_file()), None)


def _one(folder: Path, name: str, endings: tuple[str, ...]) -> Path:
    found = _find(folder, name, endings)
    if found is None:
        raise ValueError(f"no colour picture for {name} in {folder}: expected {name} with {', '.join(endings)}")
    return found
