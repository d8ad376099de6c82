"""Readers of the real datasets: folders on disk -> :class:`Sample`, one class per dataset.

Each is a lazy list: it looks for file names when made, reads a frame when indexed, holds no open file and can be
pickled, so ``torch.utils.data.DataLoader`` takes it as it is. Nothing is downloaded.

Paper: Sec. V-A (ClearGrasp, TODD, STD), Sec. V-F (TROSD); TransCG, whose size the paper gives for TODD, is added.
"""

import json
from pathlib import Path

import numpy as np

from .camera import read_intrinsics
from .data import OPAQUE, REFLECTIVE, TRANSPARENT, Camera, Sample
from .files import read_array, read_depth, read_labels, read_mask, read_rgb


class FrameFolder:
    """A folder of frames, found by the file that holds the raw depth.

    Args:
        root: the dataset's folder, or any folder inside it that holds frames.
        split: keep only the frames of this split; None keeps all.

    Raises:
        ValueError: for a root or split without frames; the message gives the layout that was looked for.
    """

    layout = ""  # for the message
    frame, suffix = "", ""  # glob of the raw depth files, and what is cut off to make the frame's name
    splits: tuple[str, ...] = ()

    def __init__(self, root: Path | str, split: str | None = None):
        self.root, self.split = Path(root), split
        if split is not None and split not in self.splits:
            raise ValueError(
                f"unknown split {split!r} of {type(self).__name__}; choose {', '.join(self.splits)} or None"
            )
        found = self.root.rglob(self.frame) if self.root.is_dir() else []
        names = (path.relative_to(self.root).as_posix().removesuffix(self.suffix) for path in found)
        self.names = sorted(name for name in names if split is None or self._in_split(name))
        if not self.names:
            which = f" of split {split!r}" if split else ""
            raise ValueError(f"no {type(self).__name__} frames{which} in {self.root}: expected {self.layout}")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.names)

    def __getitem__(self, index: int | str) -> Sample:
        """Read one frame, by position or by name.

        Raises:
            IndexError: past the end, so that a plain ``for`` loop stops.
            ValueError: for an unknown name, or a frame whose files are absent, unreadable or of different sizes.
        """
        if isinstance(index, str) and index not in self.names:
            raise ValueError(f"no frame called {index!r} in {self.root}; see .names")
        name = index if isinstance(index, str) else self.names[index]
        sample = self._read(name, self.root / name)
        for key in ("depth", "depth_gt", "region"):
            array = getattr(sample, key)
            if array is not None and array.shape != sample.rgb.shape[:2]:
                raise ValueError(f"{name}: {key} is {array.shape}, the colour picture {sample.rgb.shape[:2]}")
        return sample

    def _in_split(self, name: str) -> bool:
        return self.split in Path(name).parts or self.split in self.root.parts

    def _read(self, name: str, stem: Path) -> Sample:
        raise NotImplementedError


class ClearGrasp(FrameFolder):
    """ClearGrasp's real frames; a flat folder of such files will do.

    Raw depth was taken of the transparent objects, ground truth of opaque twins put in their places.
    """

    layout = "{real-val,real-test}/{d415,d435}/NNN-transparent-depth-img.exr (or such files right in it)"
    frame, suffix = "*-transparent-depth-img.exr", "-transparent-depth-img.exr"
    splits = ("real-val", "real-test")

    def _read(self, name: str, stem: Path) -> Sample:
        rgb = read_rgb(_beside(stem, "-transparent-rgb-img.jpg"))
        mask, truth = _beside(stem, "-mask.png"), _beside(stem, "-opaque-depth-img.exr")
        camera = stem.parent / "camera_intrinsics.yaml"
        region = read_mask(mask) if mask.is_file() else None
        return Sample(
            name=name,
            rgb=rgb,
            depth=read_depth(_beside(stem, self.suffix), allow_empty=True),
            depth_gt=read_depth(truth) if truth.is_file() else None,
            region=region,
            camera=read_intrinsics(camera, rgb.shape[:2]) if camera.is_file() else None,
            material=None if region is None else np.where(region, TRANSPARENT, OPAQUE).astype(np.uint8),
            meta={"dataset": "ClearGrasp"},
        )


class TODD(FrameFolder):
    """Toronto Transparent Objects Depth Dataset. Pixels that its masks tell to ignore have no ground truth here."""

    layout = "{train,val,test}/TIMESTAMP/depth.exr beside image.jpg, detph_GroundTruth.exr and instance_segment.png"
    frame, suffix = "depth.exr", "/depth.exr"
    splits = ("train", "val", "test")
    ignored = 255

    def _read(self, name: str, stem: Path) -> Sample:
        instances = _red(stem / "instance_segment.png")
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


class STD(FrameFolder):
    """STD, the real frames of DREDS: diffuse, transparent and specular objects of known and of novel categories.

    Splits: ``train`` and ``test`` of STD-CatKnown, ``novel`` = STD-CatNovel.
    """

    layout = "STD-CatKnown/{train_*,test_*}/ and STD-CatNovel/*/ with NNNN_{color.png,depth_415.exr,gt_depth.exr,...}"
    frame, suffix = "*_depth_415.exr", "_depth_415.exr"
    splits = ("train", "test", "novel")
    materials = {2: TRANSPARENT, 3: REFLECTIVE}  # 0 and 1 are diffuse

    def _in_split(self, name: str) -> bool:
        parts = (self.root / name).parts
        if self.split == "novel":
            return "STD-CatNovel" in parts
        return "STD-CatNovel" not in parts and any(part.startswith(f"{self.split}_") for part in parts)

    def _read(self, name: str, stem: Path) -> Sample:
        rgb = read_rgb(_beside(stem, "_color.png"))
        instances = read_labels(_beside(stem, "_mask.png"))  # 255 = background
        material = np.zeros(instances.shape, np.uint8)
        for line in _text(_beside(stem, "_meta.txt")).splitlines():
            words = line.split()
            if words:  # long rows: id label folder name scale material ..., short ones: id label material
                code = int(words[5] if len(words) > 5 else words[2])
                material[instances == int(words[0])] = self.materials.get(code, OPAQUE)
        height, width = rgb.shape[:2]
        return Sample(
            name=name,
            rgb=rgb,
            depth=read_depth(_beside(stem, self.suffix), allow_empty=True),
            depth_gt=read_depth(_beside(stem, "_gt_depth.exr")),
            region=material != OPAQUE,
            camera=Camera(918.295, 917.544, width / 2 - 0.5, height / 2 - 0.5, width, height),
            material=material,
            instances=np.where(instances == 255, 0, instances + 1).astype(np.uint8),
            meta={"dataset": "STD"},
        )


class TROSD(FrameFolder):
    """TROSD: transparent and reflective objects under several cameras; it has no ground-truth depth.

    Its test list holds frames of ClearGrasp's real-test: do not train on those and then report ClearGrasp.
    """

    layout = "{train,test}/{rgb/*.jpg, depth/*.png, mask/*.png}"
    frame, suffix = "depth/*.png", ".png"
    splits = ("train", "test")

    def _read(self, name: str, stem: Path) -> Sample:
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
    sensors = {"1": ("D435", 0.001), "2": ("L515", 0.00025)}  # metres per unit

    def __init__(self, root: Path | str, split: str | None = None):
        metadata = Path(root) / "metadata.json"
        self._scenes = json.loads(metadata.read_text()) if metadata.is_file() else {}
        super().__init__(root, split)
        scenes = {name.split("/")[0] for name in self.names}
        valid = {scene: json.loads(_text(self.root / scene / "metadata.json")) for scene in scenes}
        self.names = [name for name in self.names if _valid_view(name, valid, self.sensors)]

    def _in_split(self, name: str) -> bool:
        return int(name.split("/")[0].removeprefix("scene")) in self._scenes.get(self.split, ())

    def _read(self, name: str, stem: Path) -> Sample:
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


REGISTRY = {reader.__name__.lower(): reader for reader in (ClearGrasp, TODD, STD, TROSD, TransCG)}


def _beside(stem: Path, suffix: str) -> Path:
    return stem.with_name(stem.name + suffix)


def _text(path: Path) -> str:
    if not path.is_file():
        raise ValueError(f"no file {path}")
    return path.read_text()


def _red(path: Path) -> np.ndarray:
    """Return the labels of a picture that keeps them in its red channel, or in its only one."""
    labels = read_array(path)
    return labels if labels.ndim == 2 else labels[..., 0]


def _valid_view(name: str, valid: dict, sensors: dict) -> bool:
    scene, view, file = name.split("/")
    return int(view) in valid[scene][f"{sensors[file[-1]][0]}_valid_perspective_list"]
