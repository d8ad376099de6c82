"""Any camera: a folder of your own frames, colour and depth under the same names."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..data import OPAQUE, TRANSPARENT, Sample
from ..files import COLOUR, DEPTH, MASK, read_depth, read_intrinsics, read_mask, read_rgb
from .base import FrameFolder

CAMERAS = tuple(f"intrinsics{ending}" for ending in (".txt", ".npy", ".yaml", ".yml", ".json"))


class Folder(FrameFolder):
    """Frames of any camera: ``rgb/NAME``, ``depth/NAME``, and, where they are known, ``region/``, ``truth/``, a camera.

    Args:
        root: the folder.
        split: None; a folder of one's own has no splits.
        depth_scale: metres per unit of depth; None for millimetres of whole numbers and metres of others.
    """

    layout = (
        "rgb/NAME.{png,jpg,...}, depth/NAME.{png,tif,npy,exr}; may have region/NAME.png, truth/NAME.*, intrinsics.txt"
    )
    frame = "depth/*"
    protocol = "Depth aligned to the colour picture, 0 = missing. Without truth/ there is nothing to score: look."

    def __init__(self, root: Path | str, split: str | None = None, depth_scale: float | None = None):
        self.depth_scale = depth_scale
        super().__init__(root, split)

    def find(self, glob: str) -> Iterable[Path]:
        """Return the depth maps below the root, whatever the case of their suffix."""
        return (path for path in super().find(glob) if path.suffix.lower() in DEPTH)

    def files(self, names: Sequence[str]) -> list[list[Path]]:
        """Return, for each of the frames, the files that its maps are read from; each folder is listed but once."""
        listed: dict[Path, dict[str, list[Path]]] = {}
        found = []
        for name in names:
            depth = self.root / name
            folder = depth.parent
            if folder not in listed:
                listed[folder] = _by_stem(folder.parent / kind for kind in ("rgb", "region", "truth"))
            found.append([depth, *listed[folder].get(depth.stem, ())])
        return found

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        folder, known = stem.parents[1], stem.stem
        rgb = read_rgb(_one(folder / "rgb", known, COLOUR))
        mask, truth = _find(folder / "region", known, MASK), _find(folder / "truth", known, DEPTH)
        region = read_mask(mask) if mask else None
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


def _by_stem(folders: Iterable[Path]) -> dict[str, list[Path]]:
    """Return stem -> files of some folders, none of one that is not there."""
    found: dict[str, list[Path]] = {}
    for folder in folders:
        for name in sorted(os.listdir(folder)) if folder.is_dir() else ():
            path = folder / name
            found.setdefault(path.stem, []).append(path)
    return found


def _find(folder: Path, name: str, endings: tuple[str, ...]) -> Path | None:
    """Return the file of a folder that is called so, with one of the endings in any case, or None."""
    if not folder.is_dir():
        return None
    named = (path for path in sorted(folder.iterdir()) if path.stem == name and path.suffix.lower() in endings)
    return next(named, None)


def _one(folder: Path, name: str, endings: tuple[str, ...]) -> Path:
    found = _find(folder, name, endings)
    if found is None:
        raise ValueError(f"no colour picture for {name} in {folder}: expected {name} with {', '.join(endings)}")
    return found
