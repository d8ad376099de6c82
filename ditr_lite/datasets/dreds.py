"""STD and DREDS (Dai et al., 2022): diffuse, transparent and specular household objects, real and simulated.

Paper: Sec. V-A and V-C, Table III.
"""

from pathlib import Path

import numpy as np

from ..camera import Camera
from ..data import OPAQUE, REFLECTIVE, TRANSPARENT, Sample
from ..files import read_array, read_depth, read_labels, read_rgb, read_text
from .base import FrameFolder, beside

MATERIALS = {2: TRANSPARENT, 3: REFLECTIVE}  # 0 and 1 are diffuse
BACKGROUND = 255  # of the instance masks


class STD(FrameFolder):
    """STD, the real frames of DREDS: diffuse, transparent and specular objects of known and of novel categories.

    Splits: ``train`` and ``test`` of STD-CatKnown, ``novel`` = STD-CatNovel.
    """

    layout = "STD-CatKnown/{train_*,test_*}/ and STD-CatNovel/*/ with NNNN_{color.png,depth_415.exr,gt_depth.exr,...}"
    frame, suffix = "*_depth_415.exr", "_depth_415.exr"
    truth, mask = "_gt_depth.exr", "_mask.png"
    splits = ("train", "test", "novel")
    focal = (918.295, 917.544, 1280)  # fx, fy, width of the picture they hold for
    known, novel = "STD-CatKnown", "STD-CatNovel"
    protocol = (
        "Paper, Sec. V-C: train on STD-CatKnown's 13 training scenes, test on its 12 test scenes and on the 5 of "
        "STD-CatNovel; absent ground truth is left out. For ClearGrasp, the geometric branch is trained on ALL of "
        "STD-CatKnown, which is sound as long as no STD score comes from the same weights."
    )

    def in_split(self, name: str) -> bool:
        """Return whether the frame's scene belongs to the split; one of CatNovel to that, whatever it is called."""
        halves = [part for part in (self.root / name).parts if part in (self.known, self.novel)]
        if self.novel in halves[-1:]:
            return self.split == "novel"
        return super().in_split(name)

    def is_called(self, folder: str, split: str) -> bool:
        """Return whether a folder is called like a split or begins with it, as ``train_0`` does."""
        return split != "novel" and (folder == split or folder.startswith(f"{split}_"))

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files of colour, depth, truth, mask and materials."""
        others = ("_color.png", self.suffix, self.mask, "_meta.txt")
        return [self.truth_of(stem), *(beside(stem, ending) for ending in others)]

    def truth_of(self, stem: Path) -> Path:
        """Return the file of true depth."""
        return beside(stem, self.truth)

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        rgb = read_rgb(beside(stem, "_color.png"))
        instances = self.instances(beside(stem, self.mask))
        material = np.full(instances.shape, OPAQUE, np.uint8)
        for instance, code in _materials(beside(stem, "_meta.txt")):
            material[instances == instance] = MATERIALS.get(code, OPAQUE)
        height, width = rgb.shape[:2]
        fx, fy, wide = self.focal
        zoom = width / wide
        return Sample(
            name=name,
            rgb=rgb,
            depth=read_depth(beside(stem, self.suffix), allow_empty=True),
            depth_gt=read_depth(self.truth_of(stem)),
            region=material != OPAQUE,
            camera=Camera(fx * zoom, fy * zoom, width / 2 - 0.5, height / 2 - 0.5, width, height),
            material=material,
            instances=np.where(instances == BACKGROUND, 0, instances + 1).astype(np.uint8),
            meta={"dataset": type(self).__name__},
        )

    def instances(self, path: Path) -> np.ndarray:
        """Return (H, W) instance ids, 255 where there is none."""
        return read_labels(path)


class DREDS(STD):
    """DREDS, simulated: the same objects rendered under a simulated active-stereo camera, as our own scenes are."""

    layout = (
        "DREDS-CatKnown/{train,val,test}/SCENE/ and DREDS-CatNovel/SCENE/ with NNNN_{color.png,simDepthImage.exr,...}"
    )
    frame, suffix = "*_simDepthImage.exr", "_simDepthImage.exr"
    truth, mask = "_depth_120.exr", "_mask.exr"
    splits = ("train", "val", "test", "novel")
    focal = (446.31, 446.31, 640)
    known, novel = "DREDS-CatKnown", "DREDS-CatNovel"
    protocol = (
        "Not used by the paper; its simulator is the recipe of ours, so it is the nearest relative of data_samples."
    )

    def truth_of(self, stem: Path) -> Path:
        """Return the file of true depth, which is called otherwise in some of the test scenes."""
        usual, other = super().truth_of(stem), beside(stem, "_depth_0.exr")
        return other if other.is_file() and not usual.is_file() else usual

    def instances(self, path: Path) -> np.ndarray:
        """Return (H, W) instance ids; the file holds id / 255."""
        return np.rint(np.nan_to_num(read_array(path)) * 255).astype(np.uint8)


def _materials(path: Path) -> list[tuple[int, int]]:
    """Return (instance id, code of its material) of every row of a frame's description."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        try:
            if words:
                rows.append((int(words[0]), int(words[5] if len(words) > 5 else words[2])))
        except (IndexError, ValueError):
            raise ValueError(
                f"{path}, line {number}: expected 'id label folder name scale material ...' or 'id label material', "
                f"got {line!r}"
            ) from None
    return rows
