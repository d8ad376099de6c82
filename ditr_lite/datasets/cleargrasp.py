"""ClearGrasp (Sajjan et al., 2020): transparent plastic objects, real frames and rendered ones.

Paper: Sec. V-A and V-C, Table I.
"""

import math
from pathlib import Path

import numpy as np

from ..camera import Camera
from ..data import OPAQUE, TRANSPARENT, Sample
from ..files import read_depth, read_intrinsics, read_json, read_mask, read_rgb
from .base import FrameFolder, beside

FIELD_OF_VIEW = (1.2112585306167603, 0.7428327202796936)  # radians across and down, where a JSON does not say


class ClearGrasp(FrameFolder):
    """ClearGrasp's real frames; a flat folder of such files will do.

    Raw depth was taken of the transparent objects, ground truth of opaque twins put in their places.
    """

    layout = "{real-val,real-test}/{d415,d435}/NNN-transparent-depth-img.exr (or such files right in it)"
    frame, suffix = "*-transparent-depth-img.exr", "-transparent-depth-img.exr"
    splits = ("real-val", "real-test")
    protocol = (
        "Paper, Sec. V: 286 frames, which we read as test frames only; scores on pixels with ground truth. 'We do not "
        "differentiate the training and testing process': keep real-test out of whatever you tune."
    )

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files of colour, depth, truth and mask."""
        endings = ("-transparent-rgb-img.jpg", self.suffix, "-opaque-depth-img.exr", "-mask.png")
        return [beside(stem, ending) for ending in endings]

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        rgb = read_rgb(beside(stem, "-transparent-rgb-img.jpg"))
        mask, truth = beside(stem, "-mask.png"), beside(stem, "-opaque-depth-img.exr")
        camera = stem.parent / "camera_intrinsics.yaml"
        region = read_mask(mask) if mask.is_file() else None
        return Sample(
            name=name,
            rgb=rgb,
            depth=read_depth(beside(stem, self.suffix), allow_empty=True),
            depth_gt=read_depth(truth) if truth.is_file() else None,
            region=region,
            camera=read_intrinsics(camera, rgb.shape[:2]) if camera.is_file() else None,
            material=None if region is None else np.where(region, TRANSPARENT, OPAQUE).astype(np.uint8),
            meta={"dataset": "ClearGrasp"},
        )


class ClearGraspSynthetic(FrameFolder):
    """ClearGrasp's rendered frames, a folder per object. They have no raw depth: it is the truth without the region."""

    layout = (
        "OBJECT/{rgb-imgs,depth-imgs-rectified,segmentation-masks,json-files}/NNN-{rgb.jpg,depth-rectified.exr,...}"
    )
    frame, suffix = "depth-imgs-rectified/*-depth-rectified.exr", "-depth-rectified.exr"
    splits = ("train", "val", "test")
    protocol = (
        "Paper, Sec. V-C: training, 'setting the depth values inside the mask to zero since the simulated training set "
        "only has the ground truth depth values'. Outside the mask nothing is missing, so the geometric branch learns "
        "nothing here; the paper trains it on STD-CatKnown."
    )

    def is_called(self, folder: str, split: str) -> bool:
        """Return whether a folder is called like a split or ends in it, as ``cup-val`` does."""
        return folder == split or folder.endswith(f"-{split}")

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files of colour, depth and mask."""
        folder, number = stem.parents[1], stem.name
        colour = folder / "rgb-imgs" / f"{number}-rgb.jpg"
        return [colour, beside(stem, self.suffix), folder / "segmentation-masks" / f"{number}-segmentation-mask.png"]

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        folder, number = stem.parents[1], stem.name
        rgb = read_rgb(folder / "rgb-imgs" / f"{number}-rgb.jpg")
        truth = read_depth(beside(stem, self.suffix))
        region = read_mask(folder / "segmentation-masks" / f"{number}-segmentation-mask.png")
        described = folder / "json-files" / f"{number}-masks.json"
        outlines = folder / "outlines" / f"{number}-outlineSegmentation.png"
        angles = _field_of_view(described) if described.is_file() else FIELD_OF_VIEW
        height, width = rgb.shape[:2]
        fx, fy = (pixels / 2 / math.tan(angle / 2) for pixels, angle in zip((width, height), angles, strict=True))
        return Sample(
            name=name,
            rgb=rgb,
            depth=np.where(region, np.float32(0), truth) if region.shape == truth.shape else truth,
            depth_gt=truth,
            region=region,
            camera=Camera(fx, fy, width / 2 - 0.5, height / 2 - 0.5, width, height),
            material=np.where(region, TRANSPARENT, OPAQUE).astype(np.uint8),
            meta={"dataset": "ClearGrasp synthetic", "outlines": str(outlines) if outlines.is_file() else None},
        )


def _field_of_view(path: Path) -> tuple[float, float]:
    try:
        angles = read_json(path)["camera"]["field_of_view"]
        found = float(angles["x_axis_rads"]), float(angles["y_axis_rads"])
    except (KeyError, TypeError, ValueError):  # the public loaders fall back to the same camera
        return FIELD_OF_VIEW
    if not all(0 < angle < math.pi for angle in found):
        raise ValueError(f"{path} should give a field of view between 0 and pi radians, got {found}")
    return found
