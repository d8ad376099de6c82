"""Pictures, depth maps, masks, cameras and point clouds on disk: one reader or writer each, for any camera.

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

from .camera import Camera, unproject
from .units import check_metres, clean_depth, depth_to_png

EXR_MAGIC = b"\x76\x2f\x31\x01"
NO_READING = 65535  # the largest 16-bit number, which some recorders store for "nothing read", whatever their unit
KEYS = ("fx", "fy", "cx", "cy", "xres", "yres")  # of a camera in a .yaml file
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
    path, depth_m = Path(path), check_metres(depth_m)
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


def read_intrinsics(path: Path | str, size: tuple[int, int] | None = None) -> Camera:
    """Read a pinhole camera.

    Args:
        path: a 3x3 matrix as text or .npy, or lines ``fx: ...`` with fx, fy, cx, cy and perhaps xres, yres (.yaml).
        size: (height, width) of the picture; needed where the file does not say it, checked where it does.

    Raises:
        ValueError: for a file of another kind, an unknown or contradictory size, a number that is not finite, or a
            focal length <= 0.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    values = _yaml(path) if path.suffix in (".yaml", ".yml") else _matrix(path)
    missing = {"fx", "fy", "cx", "cy"} - set(values)
    if missing:
        raise ValueError(f"{path} lacks {', '.join(sorted(missing))}: expected fx, fy, cx and cy in pixels")
    wrong = [f"{key} {values[key]}" for key in KEYS if not np.isfinite(values.get(key, 0))]
    if wrong:
        raise ValueError(f"{path} should hold finite numbers, got {', '.join(wrong)}")
    if not (values["fx"] > 0 and values["fy"] > 0):
        raise ValueError(f"{path} should have positive focal lengths, got fx {values['fx']}, fy {values['fy']}")
    own = (int(values["yres"]), int(values["xres"])) if {"xres", "yres"} <= set(values) else None
    if own is None and size is None:
        raise ValueError(f"{path} does not say its picture's size: pass size=(height, width)")
    if own and size and own != tuple(size):
        raise ValueError(f"{path} is for pictures of {own} (height, width), not {tuple(size)}: use Camera.resized")
    height, width = own or size
    return Camera(values["fx"], values["fy"], values["cx"], values["cy"], int(width), int(height))


def write_ply(path: Path | str, depth_m: np.ndarray, rgb: np.ndarray, camera: Camera) -> int:
    """Write the valid pixels as a coloured point cloud (binary PLY) and return how many there are.

    Coordinates are the camera's own: metres, x right, y down, z forward.

    Raises:
        ValueError: when depth, RGB and camera differ in size.
    """
    points = unproject(depth_m, camera)
    if rgb.shape != (*depth_m.shape, 3) or rgb.dtype != np.uint8:
        raise ValueError(f"rgb should be {(*depth_m.shape, 3)} uint8 like the depth map, got {rgb.shape} {rgb.dtype}")
    fields = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(points), dtype=fields)
    for k, (name, _) in enumerate(fields):
        vertices[name] = points[:, k] if k < 3 else rgb[depth_m > 0][:, k - 3]
    header = ["ply", "format binary_little_endian 1.0", "comment metres, camera frame: x right, y down, z forward"]
    header += [f"element vertex {len(points)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    with written_whole(path) as part:
        part.write_bytes(("\n".join(header) + "\nend_header\n").encode("ascii") + vertices.tobytes())
    return len(points)


def _yaml(path: Path) -> dict[str, float]:
    """Return the ``name: number`` lines of a file; all that a camera file needs of YAML."""
    values = {}
    for line in path.read_text().splitlines():
        key, _, value = line.partition("#")[0].partition(":")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            continue  # a comment, a heading, a camera's name
    return values


def _matrix(path: Path) -> dict[str, float]:
    try:
        k = read_array(path) if path.suffix == ".npy" else np.loadtxt(_rows(path))
    except ValueError as error:
        raise ValueError(f"cannot read {path} as a 3x3 camera matrix: {error}") from None
    if k.shape != (3, 3) or not np.allclose(k[2], [0, 0, 1]):
        raise ValueError(f"{path} should hold a 3x3 camera matrix with last row 0 0 1, got shape {k.shape}")
    return {"fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}


def _rows(path: Path) -> list[str]:
    """Return the lines of a file of numbers, without commas and comments."""
    lines = (line.partition("#")[0].replace(",", " ").strip() for line in path.read_text().splitlines())
    rows = [line for line in lines if line]
    if not rows:  # NumPy would warn and return an empty array
        raise ValueError("it holds no numbers")
    return rows
