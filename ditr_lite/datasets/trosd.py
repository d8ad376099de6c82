"""TROSD (Sun et al., 2023): real frames of transparent and reflective objects, without ground-truth depth.

Paper: Sec. V-F.
"""

from pathlib import Path

import numpy as np

from ..data import OPAQUE, REFLECTIVE, TRANSPARENT, Sample
from ..files import read_depth, read_rgb, read_text
from .base import FrameFolder, is_hidden


class TROSD(FrameFolder):
    """TROSD: transparent and reflective objects under several cameras; it has no ground-truth depth.

    Its test list holds frames of ClearGrasp's real-test: do not train on those and then report ClearGrasp.
    """

    layout = "{train,test}/{rgb/*.jpg, depth/*.png, mask/*.png}, perhaps with lists train*.txt, test*.txt"
    frame, suffix = "depth/*.png", ".png"
    splits = ("train", "test")
    protocol = (
        "Paper, Sec. V-F: pictures only, by a model trained on TODD. Its test list holds frames of ClearGrasp's "
        "real-test: whoever trains on it cannot report ClearGrasp."
    )

    def __init__(self, root: Path | str, split: str | None = None):
        found = sorted(Path(root).glob(f"{split}*.txt")) if split in self.splits else []
        lists = [path for path in found if not is_hidden(path, Path(root))]
        rows = [line.split() for path in lists for line in read_text(path).splitlines()]
        self._listed = {Path(row[0]).stem for row in rows if row} if lists else None  # a row begins with a file's path
        super().__init__(root, split)

    def in_split(self, name: str) -> bool:
        """Return whether a list of the split names the frame, or, without lists, whether its folder is called so."""
        return super().in_split(name) if self._listed is None else Path(name).name in self._listed

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files of colour, depth and mask."""
        folder, file = stem.parents[1], stem.name
        return [folder / "rgb" / f"{file}.jpg", folder / "depth" / f"{file}.png", folder / "mask" / f"{file}.png"]

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        folder, file = stem.parents[1], stem.name
        mask = read_rgb(folder / "mask" / f"{file}.png")
        material = np.where(mask[..., 0] > 127, TRANSPARENT, OPAQUE).astype(np.uint8)  # red
        material[mask[..., 1] > 127] = REFLECTIVE  # green
        return Sample(
            name=name,
            rgb=read_rgb(folder / "rgb" / f"{file}.jpg"),
            depth=read_depth(folder / "depth" / f"{file}.png", allow_empty=True),
            region=material != OPAQUE,
            material=material,
            meta={"dataset": "TROSD"},
        )
