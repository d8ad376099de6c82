"""Pictures, depth maps and masks on disk: one reader or writer each, for any camera.

Every writer goes through a temporary name and a rename, so a file is there whole or not at all. Every reader raises a
ValueError that names the file, what was expected and what came.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

from .data import clean_depth, depth_to_png

EXR_MAGIC = b"\x76\x2f\x31\x01"
NO_READING = 65535  # the largest 16-bit number, which some recorders store for "nothing read", whatever their unit
MASK_LEVEL = 100  # of 255: masks drawn with soft edges, as ClearGrasp's, are cut here


@contextmanager
def written_whole(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` and rename it to ``path`` when the block ends without an error.

    The temporary name keeps the suffix (writers choose their format by it); missing parent folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_json(path: Path | str, values: Any) -> None:
    """Write ``values`` as JSON, whole or not at all.

    Raises:
        ValueError: for numbers that JSON does not know (NaN, infinity).
    """
    text = json.dumps(values, indent=1, allow_nan=False, default=str) + "\n"
    with written_whole(path) as part:
        part.write_text(text)


def read_rgb(path: Path | str) -> np.ndarray:
    """Read a colour picture (PNG, JPEG, or a .npy array) exactly as its pixels are stored.

    Returns:
        (H, W, 3) uint8, red first.

    Raises:
        ValueError: for anything but 8 bits in three channels. Grey and RGBA pictures are refused, not guessed at.
    """
    image = read_array(path)
    if image.ndim == 2:
        raise ValueError(
            f"{path} is a grey picture {image.shape}: expected RGB (H, W, 3); was a depth map or mask given?"
        )
    if image.ndim == 3 and image.shape[2] == 4:
        raise ValueError(f"{path} has four channels (RGBA): expected RGB (H, W, 3); save it without the alpha channel")
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"{path} should hold RGB as (H, W, 3) uint8, got {image.shape} {image.dtype}")
    return image


def read_depth(path: Path | str, depth_scale: float = 0.001, allow_empty: bool = False) -> np.ndarray:
    """Read a depth map; NaN, infinite, negative and absurd readings, and integers 65535, become 0 (missing).

    Args:
        path: 16-bit PNG or integer .npy (both times ``depth_scale``), float .npy or .exr (metres).
        depth_scale: metres per unit of the integer formats; 0.001 = millimetres.
        allow_empty: accept a map without a single valid reading.

    Returns:
        (H, W) float32 metres, 0 = missing.

    Raises:
        ValueError: for an 8-bit or colour picture, another format, or a map that holds no valid reading.
    """
    if not (np.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(f"depth_scale should be metres per unit, e.g. 0.001 for millimetres, got {depth_scale!r}")
    raw = read_array(path)
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    if raw.ndim != 2:
        raise ValueError(f"{path} should hold one depth channel (H, W), got {raw.shape}: was the colour picture given?")
    if raw.dtype == np.uint8 or raw.dtype == bool:
        raise ValueError(
            f"{path} has 8 bits a pixel: expected a 16-bit depth PNG (millimetres unless depth_scale says else)"
        )
    if raw.dtype.kind in "ui":
        # before the scale: at 0.25 mm a unit 65535 would be a believable 16.4 m
        raw = np.where(raw == NO_READING, 0.0, raw.astype(np.float64) * depth_scale)
    elif raw.dtype.kind != "f":
        raise ValueError(f"{path} should hold integers or floats, got {raw.dtype}")
    depth = clean_depth(raw)
    if not allow_empty and not depth.any():
        raise ValueError(
            f"{path} holds no valid depth: all is missing or beyond 65 m; is its unit millimetres, not metres?"
        )
    return depth


def read_mask(path: Path | str) -> np.ndarray:
    """Read a mask: a picture of 0 and 255 (cut at 100), of 0 and 1, or a boolean .npy.

    Returns:
        (H, W) bool.

    Raises:
        ValueError: for a colour picture or for values that are neither of the two kinds.
    """
    mask = read_labels(path)
    if mask.dtype == bool:
        return mask
    top = int(mask.max(initial=0))
    if 1 < top < MASK_LEVEL or top > 255:
        raise ValueError(f"{path} should be a mask of 0 and 255 (or 0 and 1), but its largest value is {top}")
    return mask > 0 if top <= 1 else mask >= MASK_LEVEL


def read_labels(path: Path | str) -> np.ndarray:
    """Read a picture of whole numbers, one channel; three equal channels count as one.

    Returns:
        (H, W) bool or integer.

    Raises:
        ValueError: when channels differ or values are not whole numbers.
    """
    labels = read_array(path)
    if labels.ndim == 3 and (labels == labels[..., :1]).all():
        labels = labels[..., 0]
    if labels.ndim != 2 or labels.dtype.kind not in "bui":
        raise ValueError(f"{path} should be one channel of whole numbers (H, W), got {labels.shape} {labels.dtype}")
    return labels


def write_depth(path: Path | str, depth_m: np.ndarray) -> None:
    """Write a depth map as 16-bit PNG (millimetres), .npy or .exr (float32 metres), by the suffix of ``path``.

    Args:
        path: where to.
        depth_m: (H, W) float, metres, 0 = missing.

    Raises:
        ValueError: for another suffix, or a map that is not finite, 2-D and non-negative.
    """
    path, depth_m = Path(path), check_depth(depth_m)
    if path.suffix == ".png":
        if depth_m.max(initial=0) > 65.535:
            raise ValueError(f"depth reaches {depth_m.max():.1f} m, a 16-bit PNG in millimetres ends at 65.5: use .npy")
        data = cv2.imencode(".png", depth_to_png(depth_m))[1].tobytes()
    elif path.suffix == ".npy":
        np.save(buffer := BytesIO(), depth_m.astype(np.float32))
        data = buffer.getvalue()
    elif path.suffix != ".exr":
        raise ValueError(f"cannot write depth as {path.suffix or path.name!r}: choose .png, .npy or .exr")
    with written_whole(path) as part:
        if path.suffix == ".exr":
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {"R": np.ascontiguousarray(depth_m, dtype=np.float32)}).write(str(part))
        else:
            part.write_bytes(data)


def check_depth(depth_m: np.ndarray) -> np.ndarray:
    """Return ``depth_m`` when it is a clean depth map, (H, W) floats in metres, finite and >= 0.

    Raises:
        ValueError: when it is not.
    """
    depth_m = np.asarray(depth_m)
    if depth_m.ndim != 2 or depth_m.dtype.kind != "f":
        raise ValueError(f"depth should be (H, W) floating-point metres, got {depth_m.shape} {depth_m.dtype}")
    if not np.isfinite(depth_m).all() or (depth_m < 0).any():
        raise ValueError("depth holds NaN, infinite or negative values: 0 means missing; see data.clean_depth")
    return depth_m


def read_array(path: Path | str) -> np.ndarray:
    """Read .npy, .exr or a picture as it is stored; colours come red first.

    Raises:
        ValueError: when the file is absent, empty, cut short or of an unknown kind.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    if path.suffix == ".npy":
        try:
            return np.load(path, allow_pickle=False)
        except (ValueError, EOFError, OSError) as error:
            raise ValueError(f"cannot read {path}: not a plain .npy array ({error})") from None
    if path.suffix == ".exr":
        return _exr(path)
    try:  # from bytes: cv2.imread cannot open non-ASCII paths on Windows
        image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise ValueError(f"cannot read {path}: expected a PNG, JPEG, .npy or .exr file, this is none or is cut short")
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., [2, 1, 0, 3][: image.shape[2]]])


def _exr(path: Path) -> np.ndarray:
    """Return the one channel of an EXR file; of several, R, if G and B repeat it."""
    with path.open("rb") as file:  # checked here: the library prints to stderr before it raises
        if file.read(4) != EXR_MAGIC:
            raise ValueError(f"cannot read {path}: not an OpenEXR file")
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"cannot read {path}: {error}") from None
    arrays = {name: channel.pixels for name, channel in channels.items()}
    if len(arrays) == 1:
        return next(iter(arrays.values()))
    if "R" not in arrays:
        raise ValueError(f"{path} has channels {sorted(arrays)}: expected one channel or R")
    if any(not np.array_equal(arrays["R"], arrays[c], equal_nan=True) for c in "GB" if c in arrays):
        raise ValueError(f"{path} has channels R, G, B that differ: a colour or normals picture, not depth")
    return arrays["R"]
