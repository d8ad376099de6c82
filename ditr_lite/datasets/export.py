"""Our scenes in the layout of each real dataset, misspelt names included: to see a format without a download.

Each writer is the inverse of the reader of the same name; what a format cannot hold (our loss types, causes, infrared
pairs; the true depth in TROSD) is left out. Colour becomes JPEG again where the format says so. Our scenes have a
camera each, these formats one for all: where they keep it in a file, that holds the first scene's.
"""

import json
import math
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from ..camera import Camera
from ..data import OPAQUE, REFLECTIVE, TRANSPARENT, Sample, lossy
from ..files import write_exr, write_picture, written_whole
from ..units import depth_to_png
from .dreds import BACKGROUND

JPEG_QUALITY = 95
ROOMS = {"rooms_train": "train", "rooms_val": "val", "rooms": "test"}  # no dataset tells the two kinds of scenes apart
SPLIT_FOLDERS = {  # ours -> theirs, where they are called otherwise
    "cleargrasp": {"train": "real-val", "val": "real-val", "test": "real-test"},
    "std": {"train": "train", "val": "test", "test": "test"},
    "trosd": {"train": "train", "val": "test", "test": "test"},
    "transcg": {"train": "train", "val": "test", "test": "test"},
}


def export(dataset: str, root: Path | str, samples: Iterable[Sample], split: str = "val") -> Path:
    """Write samples below ``root`` as ``dataset`` has them on disk, all of them or, after an error, none.

    Args:
        dataset: a name of :data:`WRITERS`.
        root: new or empty folder.
        samples: with ground truth, region and camera, as our scenes have them; numbered in their order.
        split: of our scenes, rooms included; a dataset without such a split gets its nearest (see ``SPLIT_FOLDERS``).

    Returns:
        ``root``.

    Raises:
        ValueError: for an unknown dataset, a folder that holds something, or a sample that lacks what is needed.
    """
    if dataset not in WRITERS:
        raise ValueError(f"cannot export as {dataset!r}; choose one of {', '.join(WRITERS)}")
    root = Path(root)
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(f"{root} exists and is not an empty folder: choose another place to export to")
    split = ROOMS.get(split, split)
    theirs = SPLIT_FOLDERS.get(dataset, {}).get(split, split)
    place = root.resolve().parent
    place.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".export-", dir=place) as part:
        for number, sample in enumerate(samples):
            if any(value is None for value in (sample.depth_gt, sample.material, sample.camera)):
                raise ValueError(
                    f"{sample.name} lacks ground truth, material or camera: only our own scenes can be exported"
                )
            WRITERS[dataset](Path(part), theirs, number, sample)
        root.mkdir(exist_ok=True)
        for entry in sorted(Path(part).iterdir()):
            shutil.move(entry, root / entry.name)
    return root


def _cleargrasp(root: Path, split: str, number: int, sample: Sample) -> None:
    folder = root / split / "d435"
    stem = f"{number:09d}"
    _picture(folder / f"{stem}-transparent-rgb-img.jpg", sample.rgb)
    _picture(folder / f"{stem}-opaque-rgb-img.jpg", sample.rgb)  # theirs shows painted twins; nothing reads it
    _exr(folder / f"{stem}-transparent-depth-img.exr", sample.depth, half=True)
    truth = np.where(sample.depth_gt > 0, sample.depth_gt, np.nan)
    _exr(folder / f"{stem}-opaque-depth-img.exr", truth, half=True)
    _picture(folder / f"{stem}-mask.png", 255 * _region(sample).astype(np.uint8))
    c = sample.camera
    values = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "xres": c.width, "yres": c.height}
    _text(folder / "camera_intrinsics.yaml", "".join(f"{key}: {value}\n" for key, value in values.items()), once=True)


def _cleargrasp_synthetic(root: Path, split: str, number: int, sample: Sample) -> None:
    folder, stem = root / f"table-top-{split}", f"{number:09d}"
    _picture(folder / "rgb-imgs" / f"{stem}-rgb.jpg", sample.rgb)
    _exr(folder / "depth-imgs-rectified" / f"{stem}-depth-rectified.exr", sample.depth_gt)
    region = _region(sample).astype(np.uint8)
    _picture(folder / "segmentation-masks" / f"{stem}-segmentation-mask.png", 255 * region)
    outline = cv2.morphologyEx(region, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    _picture(folder / "outlines" / f"{stem}-outlineSegmentation.png", outline)
    c = sample.camera
    angles = {"x_axis_rads": 2 * math.atan(c.width / 2 / c.fx), "y_axis_rads": 2 * math.atan(c.height / 2 / c.fy)}
    image = {"height_px": c.height, "width_px": c.width}
    _text(
        folder / "json-files" / f"{stem}-masks.json", json.dumps({"camera": {"field_of_view": angles, "image": image}})
    )


def _todd(root: Path, split: str, number: int, sample: Sample) -> None:
    folder = root / split / f"{1622500000 + number}.0"
    _picture(folder / "image.jpg", sample.rgb)
    _exr(folder / "depth.exr", np.where(sample.depth > 0, sample.depth, np.nan))
    _exr(folder / "detph_GroundTruth.exr", sample.depth_gt)  # the dataset's own spelling
    ids = np.where(_region(sample), sample.instances if sample.instances is not None else 1, 0)
    dense = np.searchsorted(np.union1d(ids, 0), ids)  # written as 10, 20, ...: eight bits hold 25 objects
    if dense.max() > 25:
        raise ValueError(
            f"{sample.name} has {dense.max()} transparent or reflective things, TODD room for 25: export as another"
        )
    _picture(folder / "instance_segment.png", (10 * dense).astype(np.uint8))
    _text(folder / "pose_type.json", "{}")


def _std(root: Path, split: str, number: int, sample: Sample) -> None:
    folder = root / "STD-CatKnown" / f"{split}_0"
    _dreds_frame(folder, number, sample, ("_depth_415.exr", "_gt_depth.exr"))
    ids = _ids(sample)
    _picture(folder / f"{number:04d}_mask.png", ids)


def _dreds(root: Path, split: str, number: int, sample: Sample) -> None:
    folder = root / "DREDS-CatKnown" / split / "0"
    _dreds_frame(folder, number, sample, ("_simDepthImage.exr", "_depth_120.exr"))
    _exr(folder / f"{number:04d}_mask.exr", _ids(sample) / 255)


def _dreds_frame(folder: Path, number: int, sample: Sample, suffixes: tuple[str, str]) -> None:
    stem = f"{number:04d}"
    _picture(folder / f"{stem}_color.png", sample.rgb)
    for suffix, depth in zip(suffixes, (sample.depth, sample.depth_gt), strict=True):
        _exr(folder / (stem + suffix), depth)
    ids, rows = _ids(sample), []
    for k in np.unique(ids[ids != BACKGROUND]):
        kind = int(np.bincount(sample.material[ids == k]).argmax())
        rows.append(f"{k} 1 none thing 1.0 { {OPAQUE: 0, TRANSPARENT: 2, REFLECTIVE: 3}[kind] } 1 0 0 0 0 0 0")
    _text(folder / f"{stem}_meta.txt", "\n".join(rows) + "\n")


def _trosd(root: Path, split: str, number: int, sample: Sample) -> None:
    stem = f"{number:06d}"
    _picture(root / split / "rgb" / f"{stem}.jpg", sample.rgb)
    _picture(root / split / "depth" / f"{stem}.png", depth_to_png(sample.depth))
    mask = np.zeros((*sample.depth.shape, 3), np.uint8)
    mask[sample.material == TRANSPARENT] = (255, 0, 0)
    mask[sample.material == REFLECTIVE] = (0, 255, 0)
    _picture(root / split / "mask" / f"{stem}.png", mask)
    listed = root / f"{split}.txt"
    lines = listed.read_text() if listed.is_file() else ""
    _text(listed, lines + f"{split}/rgb/{stem}.jpg\n")


def _transcg(root: Path, split: str, number: int, sample: Sample) -> None:
    folder = root / f"scene{number + 1}" / "0"
    for k, units in (("1", 1000), ("2", 4000)):  # the D435 in millimetres, the L515 in quarters of one
        _picture(folder / f"rgb{k}.png", sample.rgb)
        for name, depth in ((f"depth{k}.png", sample.depth), (f"depth{k}-gt.png", sample.depth_gt)):
            _picture(folder / name, np.clip(np.rint(depth.astype(np.float64) * units), 0, 65535).astype(np.uint16))
        _picture(folder / f"depth{k}-gt-mask.png", 255 * _region(sample).astype(np.uint8))
        _matrix(root / "camera_intrinsics" / f"{k}-camIntrinsics-{'D435' if k == '1' else 'L515'}.npy", sample.camera)
    valid = {"D435_valid_perspective_list": [0], "L515_valid_perspective_list": [0]}
    _text(root / f"scene{number + 1}" / "metadata.json", json.dumps(valid))
    scenes = {"train": [], "test": []} | {split: list(range(1, number + 2))}
    _text(root / "metadata.json", json.dumps({"total_scenes": number + 1, **scenes}))


def _folder(root: Path, split: str, number: int, sample: Sample) -> None:
    _picture(root / "rgb" / f"{sample.name}.png", sample.rgb)
    for name, depth in (("depth", sample.depth), ("truth", sample.depth_gt)):
        _picture(root / name / f"{sample.name}.png", depth_to_png(depth))
    _picture(root / "region" / f"{sample.name}.png", 255 * _region(sample).astype(np.uint8))
    _matrix(root / "intrinsics.npy", sample.camera)


WRITERS: dict[str, Callable[[Path, str, int, Sample], None]] = {
    "cleargrasp": _cleargrasp,
    "cleargrasp_synthetic": _cleargrasp_synthetic,
    "todd": _todd,
    "std": _std,
    "dreds": _dreds,
    "trosd": _trosd,
    "transcg": _transcg,
    "folder": _folder,
}


def _region(sample: Sample) -> np.ndarray:
    return lossy(sample.material)


def _ids(sample: Sample) -> np.ndarray:
    """Return instance ids from 0, 255 for the background, as STD and DREDS count them."""
    ids = sample.material if sample.instances is None else sample.instances
    return np.where(ids == 0, BACKGROUND, ids - 1).astype(np.uint8)


def _picture(path: Path, image: np.ndarray) -> None:
    write_picture(path, image, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY) if path.suffix == ".jpg" else ())


def _exr(path: Path, depth: np.ndarray, half: bool = False) -> None:
    write_exr(path, dict.fromkeys("RGB", depth.astype(np.float16 if half else np.float32)))


def _text(path: Path, content: str, once: bool = False) -> None:
    if once and path.exists():
        return
    with written_whole(path) as part:
        part.write_text(content, encoding="utf-8")


def _matrix(path: Path, camera: Camera) -> None:
    if path.exists():
        return
    with written_whole(path) as part:
        np.save(part, np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]))
