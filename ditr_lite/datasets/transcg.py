"""TransCG (Fang et al., 2022): real frames by two cameras on a robot; the paper gives its size for TODD.

Not used by the paper.
"""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..data import OPAQUE, TRANSPARENT, Sample
from ..files import read_depth, read_intrinsics, read_json, read_mask, read_rgb
from .base import FrameFolder


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
        self._scenes = read_json(metadata) if metadata.is_file() else {}
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
        listed = self._scenes.get(self.split, [])
        if not isinstance(listed, list):
            raise ValueError(f"{self.root / 'metadata.json'} should list scenes under {self.split!r}, got {listed!r}")
        return int(name.split("/")[0].removeprefix("scene")) in listed

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files of colour, depth, truth and mask."""
        folder, k = stem.parent, stem.name[-1]
        names = (f"rgb{k}.png", f"depth{k}.png", f"depth{k}-gt.png", f"depth{k}-gt-mask.png")
        return [folder / name for name in names]

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
        views = read_json(path).get(key)
        if not isinstance(views, list):
            raise ValueError(f"{path} should list the views under {key!r}, got {views!r}")
        return views
