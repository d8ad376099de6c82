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
        self._listed: dict[str, set[str | None]] | None = {} if lists else None  # stem -> folders; None: in any
        for path in (Path(row[0]) for row in rows if row):  # a row begins with a file's path
            self._listed.setdefault(path.stem, set()).add(self._folder(path))
        super().__init__(root, split)

    def in_split(self, name: str) -> bool:
        """Return whether a list of the split names the frame, or, without lists, whether its folder is called so.

        A row that says in which of the folders train and test its file lies means no other: both may hold a 000001.
        """
        if self._listed is None:
            return super().in_split(name)
        folder, folders = self._folder(Path(name)), self._listed.get(Path(name).name, set())
        return bool(folders) if folder is None else not folders.isdisjoint({None, folder})

    def _folder(self, path: Path) -> str | None:
        """Return the nearest folder of a path that is called like a split; None where none is."""
        return next((part for part in reversed(path.parts[:-1]) if part in self.splits), None)

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
