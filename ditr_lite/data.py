"""Samples: one RGB-D frame with everything known about it, how it lies on disk, and the shipped splits.

Depth is float32 metres and 0 means missing, in raw depth and in ground truth alike.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from .camera import Camera, Stereo
from .files import folder_written_whole, read_array, read_json, read_labels, read_rgb, write_picture
from .units import clean_depth, depth_to_png

SAMPLES = Path(__file__).resolve().parents[1] / "data_samples"
SPLITS = ("train", "val", "test")
ROOM_SPLITS = ("rooms_train", "rooms_val", "rooms")  # training, validation, test
OPAQUE, TRANSPARENT, REFLECTIVE = 0, 1, 2  # values of Sample.material


@dataclass(frozen=True)
class Sample:
    """One frame. Arrays that are not known are None.

    Attributes:
        name: unique in its split.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres, raw sensor, 0 = missing.
        depth_gt: (H, W) float32 metres, first surface seen from the RGB camera, 0 = unknown.
        region: (H, W) bool, transparent or reflective.
        camera: intrinsics of the RGB view; None for a frame that came without.
        material: (H, W) uint8, 0 opaque, 1 transparent, 2 reflective, 255 not to be judged.
        instances: (H, W) uint8, 0 background, then one id per object.
        loss: (H, W) uint8, codes of ``loss_types.LossType``.
        cause: (H, W) uint8, codes of ``loss_types.Cause``.
        ir_left, ir_right: (h, w) uint8, rectified.
        stereo: geometry of the infrared pair.
        meta: whatever else the maker noted (seed, sensor, material parameters).
    """

    name: str
    rgb: np.ndarray
    depth: np.ndarray
    depth_gt: np.ndarray | None = None
    region: np.ndarray | None = None
    camera: Camera | None = None
    material: np.ndarray | None = None
    instances: np.ndarray | None = None
    loss: np.ndarray | None = None
    cause: np.ndarray | None = None
    ir_left: np.ndarray | None = None
    ir_right: np.ndarray | None = None
    stereo: Stereo | None = None
    meta: dict[str, Any] = field(default_factory=dict)


LABELS = ("material", "instances", "loss", "cause", "ir_left", "ir_right")


def save_sample(sample: Sample, folder: Path | str) -> None:
    """Write ``sample`` as a folder of images and ``meta.json``; it appears whole or not at all.

    Files: ``rgb.jpg``, ``depth.png`` and ``depth_gt.png`` (16 bit, millimetres), 8-bit PNG labels, ``region.png`` where
    no ``material.png`` says it, ``meta.json``.

    Args:
        sample: to write.
        folder: for its files; a sample that is there is replaced, anything else refused.

    Raises:
        ValueError: for a picture that cannot be encoded, a region that the material contradicts, or a folder that
            holds something else.
        OSError: when a file cannot be written.
    """
    folder = Path(folder)
    if folder.exists() and not (folder / "meta.json").is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} holds something else than a sample: choose another place")
    images = {"rgb.jpg": sample.rgb, "depth.png": depth_to_png(sample.depth)}
    if sample.depth_gt is not None:
        images["depth_gt.png"] = depth_to_png(sample.depth_gt)
    images |= {f"{key}.png": getattr(sample, key) for key in LABELS if getattr(sample, key) is not None}
    if sample.region is not None:
        if sample.material is None:  # which otherwise says it
            images["region.png"] = np.where(sample.region, np.uint8(255), np.uint8(0))
        elif not np.array_equal(sample.region, lossy(sample.material)):
            raise ValueError(f"{sample.name}: region and material disagree; leave one of them out")
    meta = {
        "camera": asdict(sample.camera) if sample.camera else None,
        "stereo": asdict(sample.stereo) if sample.stereo else None,
        "meta": sample.meta,
    }
    with folder_written_whole(folder) as part:
        for name, image in images.items():
            jpeg = name.endswith(".jpg")
            options = (cv2.IMWRITE_JPEG_QUALITY, 92) if jpeg else (cv2.IMWRITE_PNG_COMPRESSION, 9)
            write_picture(part / name, image, options)
        (part / "meta.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")


def read_sample(folder: Path | str) -> Sample:
    """Read a folder that :func:`save_sample` wrote.

    Raises:
        ValueError: when the folder or one of its required files is missing, unreadable or incomplete.
    """
    folder = Path(folder)
    camera, stereo, meta = read_meta(folder)
    rgb = read_rgb(folder / "rgb.jpg")
    depth_gt = folder / "depth_gt.png"
    labels = {k: read_labels(folder / f"{k}.png") for k in LABELS if (folder / f"{k}.png").is_file()}
    sample = Sample(
        name=folder.name,
        rgb=rgb,
        depth=_metres(folder / "depth.png"),
        depth_gt=_metres(depth_gt) if depth_gt.is_file() else None,
        region=_region(folder, labels),
        camera=camera,
        stereo=stereo,
        meta=meta,
        **labels,
    )
    for key in ("depth", "depth_gt", "material", "region", "instances", "loss", "cause"):
        image = getattr(sample, key)
        if image is not None and image.shape != rgb.shape[:2]:
            raise ValueError(f"{folder}: {key}.png is {image.shape}, rgb.jpg {rgb.shape[:2]}: it belongs elsewhere")
    return sample


def lossy(material: np.ndarray) -> np.ndarray:
    """Return where material codes say glass or metal; where nothing is known, and beyond a border, they say neither."""
    return (material == TRANSPARENT) | (material == REFLECTIVE)


def _region(folder: Path, labels: dict[str, np.ndarray]) -> np.ndarray | None:
    if "material" in labels:
        return lossy(labels["material"])
    path = folder / "region.png"
    return read_labels(path) > 0 if path.is_file() else None


def read_meta(folder: Path | str) -> tuple[Camera | None, Stereo | None, dict[str, Any]]:
    """Return what a sample's ``meta.json`` holds: camera, geometry of the infrared pair, the maker's notes.

    Raises:
        ValueError: when it is missing, no JSON, or without one of the three.
    """
    path = Path(folder) / "meta.json"
    if not path.is_file():
        raise ValueError(f"no sample in {folder}: expected rgb.jpg, depth.png and meta.json there")
    held = read_json(path)
    try:
        camera, stereo = held["camera"], held["stereo"]
        return Camera(**camera) if camera else None, _stereo(stereo) if stereo else None, dict(held["meta"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} should be a JSON object with camera, stereo and meta, as save_sample writes it; got {error!r}"
        ) from None


def list_samples(split: str = "test", root: Path | str | None = None) -> list[str]:
    """Return the names of the shipped samples of one split (of ``SPLITS`` or ``ROOM_SPLITS``), sorted.

    Raises:
        ValueError: for an unknown split, or where there is no sample.
    """
    if split not in SPLITS + ROOM_SPLITS:
        raise ValueError(f"unknown split {split!r}; choose one of {', '.join(SPLITS + ROOM_SPLITS)}")
    folder = Path(root or SAMPLES) / split
    names = [path.name for path in sample_folders(folder)]
    if not names:
        here = "are they frames of a dataset or of your own? name it by --dataset (or datasets.REGISTRY)"
        raise ValueError(f"no samples in {folder}: {here if root else 'run ditr_lite from its repository'}")
    return names


def sample_folders(folder: Path | str) -> list[Path]:
    """Return the folders of the samples in ``folder``, sorted, but for unfinished ones and those that are hidden."""
    found = sorted(path.parent for path in Path(folder).glob("*/meta.json"))
    return [path for path in found if not (path.name.startswith(".") or path.name.endswith(".part"))]


def load_sample(name: str, root: Path | str | None = None) -> Sample:
    """Load a sample by its name, its split and a number, e.g. ``test_00003``.

    Raises:
        ValueError: for a name that no split holds.
    """
    folder = Path(root or SAMPLES) / name.rpartition("_")[0] / name
    if not folder.is_dir():
        raise ValueError(f"no sample called {name!r}; see list_samples(split) for the names")
    return read_sample(folder)


def deepest_pixel(region: np.ndarray) -> tuple[int, int]:
    """Return (row, column) of the pixel farthest from the outline of the largest connected piece of a region.

    Args:
        region: (H, W) bool; pieces that touch at a corner are one, and the border of the image is no outline.

    Raises:
        ValueError: when the region is empty.
    """
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(np.asarray(region, bool).astype(np.uint8))
    if len(stats) < 2:
        raise ValueError("the region is empty: there is no pixel to follow")
    piece = pieces == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()
    row, column = np.unravel_index(distance_transform_edt(piece).argmax(), piece.shape)
    return int(row), int(column)


def followed(root: Path | str | None = None) -> tuple[Sample, tuple[int, int]]:
    """Return the frame and the pixel (row, column) that the notebooks follow, chosen by rule and not for their looks.

    Of the first twelve test scenes, the one with the largest region; in it, the :func:`deepest_pixel`.
    """
    scenes = (load_sample(name, root) for name in list_samples("test", root)[:12])
    scene = max(scenes, key=lambda s: s.region.sum())
    return scene, deepest_pixel(scene.region)


def _stereo(values: dict[str, Any]) -> Stereo:
    motion = tuple(tuple(row) for row in values["rgb_from_left"])
    return Stereo(Camera(**values["camera"]), values["baseline_m"], motion)


def _metres(path: Path) -> np.ndarray:
    image = read_array(path)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise ValueError(
            f"{path} should be a 16-bit single-channel PNG in millimetres, got {image.dtype} {image.shape}"
        )
    return clean_depth(image.astype(np.float32) / 1000.0)
