"""TODD, TROSD and TransCG: real frames of transparent (and reflective) objects under four kinds of camera.

Paper: Sec. V-A, V-C and Table II (TODD), Sec. V-F (TROSD); TransCG, whose size the paper gives for TODD, is added.
"""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..camera import Camera
from ..data import OPAQUE, REFLECTIVE, TRANSPARENT, Sample
from ..files import read_depth, read_intrinsics, read_mask, read_rgb
from .base import FrameFolder, described, red


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

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        instances = red(stem / "instance_segment.png")
        region = (instances > 0) & (instances != self.ignored)
        truth = read_depth(stem / "detph_GroundTruth.exr")  # the dataset's own spelling
        return Sample(
            name=name,
            rgb=read_rgb(stem / "image.jpg"),
            depth=read_depth(stem / "depth.exr", allow_empty=True),
            depth_gt=np.where(instances == self.ignored, np.float32(0), truth),
            region=region,
            camera=Camera(613.962, 613.756, 324.447, 239.171, 640, 480),
            material=np.where(region, TRANSPARENT, OPAQUE).astype(np.uint8),
            instances=np.where(region, instances // 10, 0).astype(np.uint8),
            meta={"dataset": "TODD"},
        )


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
        lists = sorted(Path(root).glob(f"{split}*.txt")) if split in self.splits else []
        rows = [line.split() for path in lists for line in path.read_text().splitlines()]
        self._listed = {Path(row[0]).stem for row in rows if row} if lists else None  # a row begins with a file's path
        super().__init__(root, split)

    def in_split(self, name: str) -> bool:
        """Return whether a list of the split names the frame, or, without lists, whether its folder is called so."""
        return super().in_split(name) if self._listed is None else Path(name).name in self._listed

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


class TransCG(FrameFolder):
    """TransCG: 57,715 frames by a D435 (camera 1) and an L515 (camera 2), only the views its metadata calls valid."""

    layout = "metadata.json, camera_intrinsics/*.npy and sceneN/VIEW/{rgb,depth}{1,2}.png, depth{1,2}-gt.png, ..."
    frame, suffix = "scene*/*/depth[12].png", ".png"
    splits = ("train", "test")
    protocol = (
        "Not used by the paper, which gives its size for TODD. DFNet's code scores 0.3 to 1.5 m at 320 x 240; see "
        "`evaluate --protocol`."
    )
    sensors = {"1": ("D435", 0.001), "2": ("L515", 0.00025)}  # metres per unit

    def __init__(self, root: Path | str, split: str | None = None):
        metadata = Path(root) / "metadata.json"
        self._scenes = described(metadata) if metadata.is_file() else {}
        super().__init__(root, split)
        scenes = sorted({name.split("/")[0] for name in self.names})
        valid = {(scene, k): self._views(scene, sensor) for scene in scenes for k, (sensor, _) in self.sensors.items()}
        self.names = [name for name in self.names if int(name.split("/")[1]) in valid[name.split("/")[0], name[-1]]]
        if not self.names:
            raise ValueError(f"no valid view in {self.root}: none is listed in scene*/metadata.json")

    def find(self, glob: str) -> Iterable[Path]:
        """Return the files of frames; scenes are numbered folders right in the root, where the metadata is too."""
        return (p for p in self.root.glob(glob) if re.fullmatch(r"scene\d+/\d+", "/".join(p.parts[-3:-1])))

    def in_split(self, name: str) -> bool:
        """Return whether the metadata lists the scene under the split."""
        return int(name.split("/")[0].removeprefix("scene")) in self._scenes.get(self.split, ())

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame."""
        folder, k = stem.parent, name[-1]
        sensor, scale = self.sensors[k]
        rgb = read_rgb(folder / f"rgb{k}.png")
        region = read_mask(folder / f"depth{k}-gt-mask.png")
        camera = self.root / "camera_intrinsics" / f"{k}-camIntrinsics-{sensor}.npy"
        return Sample(
            name=name,
            rgb=rgb,
            depth=read_depth(folder / f"depth{k}.png", scale, allow_empty=True),
            depth_gt=read_depth(folder / f"depth{k}-gt.png", scale),
            region=region,
            camera=read_intrinsics(camera, rgb.shape[:2]) if camera.is_file() else None,
            material=np.where(region, TRANSPARENT, OPAQUE).astype(np.uint8),
            meta={"dataset": "TransCG", "sensor": sensor},
        )

    def _views(self, scene: str, sensor: str) -> list[int]:
        """Return the views of a scene that its metadata calls valid for one camera."""
        path, key = self.root / scene / "metadata.json", f"{sensor}_valid_perspective_list"
        views = described(path).get(key)
        if not isinstance(views, list):
            raise ValueError(f"{path} should list the views under {key!r}, got {views!r}")
        return views
