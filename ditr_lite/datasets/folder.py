"""Any camera: a folder of your own frames, colour and depth under the same names."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..data import OPAQUE, TRANSPARENT, Sample
from ..files import COLOUR, DEPTH, MASK, read_array, read_depth, read_intrinsics, read_mask, read_rgb
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
        self.listed: dict[Path, dict[str, list[Path]]] = {}  # folder -> stem -> files
        super().__init__(root, split)

    def find(self, glob: str) -> Iterable[Path]:
        """Return the depth maps below the root, whatever the case of their suffix."""
        return (path for path in super().find(glob) if path.suffix.lower() in DEPTH)

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files of depth, colour, region and truth."""
        kinds = (stem.parents[1] / kind for kind in ("rgb", "region", "truth"))
        return [stem, *(path for kind in kinds for path in self.called(kind, stem.stem))]

    def scale_of_truth(self, depth: Path, truth: Path) -> float | None:
        """Return the stated scale where both maps hold whole numbers, or both floats; None where it is only depth's."""
        if self.depth_scale is None:  # then neither file need be read twice
            return None
        kinds = {read_array(path).dtype.kind == "f" for path in (depth, truth)}
        return self.depth_scale if len(kinds) == 1 else None

    def called(self, folder: Path, name: str) -> list[Path]:
        """Return the files of a folder that are called so, whatever their suffix.

        A folder is listed once: to list it for every frame takes the longer, the more there are.
        """
        if folder not in self.listed:
            self.listed[folder] = {}
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                self.listed[folder].setdefault(path.stem, []).append(path)
        return self.listed[folder].get(name, [])

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        folder, known = stem.parents[1], stem.stem
        colour, mask, truth = (
            next((path for path in self.called(folder / kind, known) if path.suffix.lower() in endings), None)
            for kind, endings in (("rgb", COLOUR), ("region", MASK), ("truth", DEPTH))
        )
        if colour is None:
            raise ValueError(f"no colour picture for {known} in {folder / 'rgb'}: expected one of {', '.join(COLOUR)}")
        rgb = read_rgb(colour)
        region = read_mask(mask) if mask else None
        camera = next((folder / c for c in CAMERAS if (folder / c).is_file()), None)
        return Sample(
            name=name,
            rgb=rgb,
            depth=read_depth(stem, self.depth_scale, allow_empty=True),
            depth_gt=read_depth(truth, self.scale_of_truth(stem, truth)) if truth else None,
            region=region,
            camera=read_intrinsics(camera, rgb.shape[:2]) if camera else None,
            material=None if region is None else np.where(region, TRANSPARENT, OPAQUE).astype(np.uint8),
            meta={"dataset": "folder"},
        )
