"""TODD (Xu et al., 2021): real frames of transparent objects from many sides.

Paper: Sec. V-A, V-C and Table II.
"""

from pathlib import Path

import numpy as np

from ..camera import Camera
from ..data import OPAQUE, TRANSPARENT, Sample
from ..files import read_depth, read_rgb
from ..region import IGNORE
from .base import FrameFolder, red


class TODD(FrameFolder):
    """Toronto Transparent Objects Depth Dataset. Pixels that its masks tell to ignore have no ground truth here."""

    layout = "{train,val,test}/TIMESTAMP/depth.exr beside image.jpg, detph_GroundTruth.exr and instance_segment.png"
    frame, suffix = "depth.exr", "/depth.exr"
    splits = ("train", "val", "test")
    protocol = (
        "Paper, Sec. V-C: the dataset's own train, val and test. The paper gives its size as 57,715 frames, which is "
        "TransCG's; its authors count nearly 15,000."
    )
    ignored = 255

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files of colour, depth, truth and mask."""
        names = ("image.jpg", "depth.exr", "detph_GroundTruth.exr", "instance_segment.png")
        return [stem / name for name in names]

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        instances = red(stem / "instance_segment.png")
        ignored = instances == self.ignored
        region = (instances > 0) & ~ignored
        height, width = instances.shape
        truth = read_depth(stem / "detph_GroundTruth.exr")  # the dataset's own spelling
        return Sample(
            name=name,
            rgb=read_rgb(stem / "image.jpg"),
            depth=read_depth(stem / "depth.exr", allow_empty=True),
            depth_gt=np.where(ignored, np.float32(0), truth),
            region=region,
            camera=Camera(613.962, 613.756, 324.447, 239.171, 640, 480).resized(width, height),
            material=np.select([ignored, region], [IGNORE, TRANSPARENT], OPAQUE).astype(np.uint8),
            instances=np.where(region, instances // 10, 0).astype(np.uint8),
            meta={"dataset": "TODD"},
        )
