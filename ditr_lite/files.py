"""Pictures, depth maps, masks, cameras and point clouds on disk: one reader or writer each, for any camera.

Every writer goes through a temporary name and a rename, so a file is there whole or not at all. Every reader raises a
ValueError that names the file, what was expected and what came.
"""

import json
import os
import re
import shutil
import struct
import sys
import threading
import time
import uuid
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from PIL import Image

from .camera import Camera, unproject
from .units import MILLIMETRES, check_metres, check_unit, clean_depth, depth_to_png, is_clean

DEPTH = (".png", ".tif", ".tiff", ".npy", ".exr")  # suffixes, in any case, that depth is read from and written as
COLOUR = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".npy")
MASK = (".png", ".tif", ".tiff", ".bmp", ".npy")
KINDS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM")  # of pictures, as Pillow calls them
MAX_PIXELS = 2**27  # 134 million: no camera has more, and a damaged header is not believed

EXR_MAGIC = b"\x76\x2f\x31\x01"
NPY_MAGIC = b"\x93NUMPY"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
PNG_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")  # that make the pixels; of others libpng prints complaints
ROS_HEADER = struct.Struct("<iff")  # of compressedDepth: format, and the two constants of inverse depth
ORIENTATION = 0x0112  # EXIF's tag; its values 2 to 8 say how to turn or mirror the stored pixels
LOCK_S = 60.0  # a lock that is older was left behind
STREAMS = threading.RLock()  # over standard output and standard error

NO_READING = 65535  # the largest 16-bit number, which some recorders store for "nothing read", whatever their unit
MASK_LEVEL = 100  # of 255: masks drawn with soft edges, as ClearGrasp's, are cut here
JUDGED = 2**20  # pixels, at least, by which swapped bytes are told
SWAPPED = 30  # times that neighbours of swapped bytes differ more than they do when these are swapped back

SIZES = (("xres", "yres"), ("width", "height"), ("image_width", "image_height"), ("w", "h"))  # of a camera's picture
CENTRES = {"ppx": "cx", "ppy": "cy"}  # RealSense's names
MATRICES = ("camera_matrix", "intrinsic_matrix", "k", "intrinsics")
CENTRE = (0.35, 0.65)  # where a principal point lies, in widths and heights
FOCAL = (0.25, 10.0)  # a focal length, in widths: fields of view from 127 to 6 degrees


@contextmanager
def written_whole(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` and rename it to ``path`` when the block ends without an error.

    The temporary name keeps the suffix (writers choose their format by it) and is nobody else's; missing parent folders
    are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.part{path.suffix}")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def folder_written_whole(folder: Path | str) -> Iterator[Path]:
    """Yield a new hidden folder beside ``folder`` and put it in its place when the block ends without an error.

    What is there is replaced, also by two writers at once: then the later one's stays, whole.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    token = uuid.uuid4().hex[:12]
    part, old = (folder.with_name(f".{folder.name}.{token}.{what}") for what in ("part", "old.part"))
    part.mkdir()
    try:
        yield part
        with locked(folder):
            try:
                if folder.exists():
                    folder.rename(old)
                part.rename(folder)
            finally:
                if old.exists() and not folder.exists():  # interrupted between the two
                    old.rename(folder)
    finally:
        for left in (part, old):
            shutil.rmtree(left, ignore_errors=True)


@contextmanager
def locked(path: Path | str) -> Iterator[None]:
    """Hold a lock on ``path`` while the block runs, so that no two writers read and change it at once.

    The lock is a file beside it, ``.NAME.lock``. One that is older than a minute was left behind and is taken over.

    Raises:
        ValueError: when other writers keep it for two minutes.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    mine, until = uuid.uuid4().hex, time.monotonic() + 2 * LOCK_S
    while not _made(lock, mine):
        if time.monotonic() > until:
            raise ValueError(f"another process is writing beside {lock}: wait for it, or delete that file if none is")
        if _left_behind(lock):
            _remove_left_behind(lock)
        time.sleep(0.02)
    try:
        yield
    finally:
        with suppress(FileNotFoundError):  # whoever took longer than a minute may have lost it to another
            if lock.read_text() == mine:
                lock.unlink(missing_ok=True)


def _made(lock: Path, text: str) -> bool:
    """Make a file that is not there; return False where it is there."""
    try:
        with lock.open("x") as file:
            file.write(text)
    except FileExistsError:
        return False
    except OSError:  # the disk is full
        lock.unlink(missing_ok=True)
        raise
    return True


def _left_behind(lock: Path) -> bool:
    try:
        return time.time() - lock.stat().st_mtime > LOCK_S
    except FileNotFoundError:  # released in between
        return False


def _remove_left_behind(lock: Path) -> None:
    """Remove a lock that was left behind; of several who want to, one does, and looks again before."""
    turn = lock.with_name(f"{lock.name}.old")
    if not _made(turn, ""):
        return
    try:
        if _left_behind(lock):
            lock.unlink(missing_ok=True)
    finally:
        turn.unlink(missing_ok=True)


def write_json(path: Path | str, values: Any) -> None:
    """Write ``values`` as JSON, whole or not at all.

    Raises:
        ValueError: for numbers that JSON does not know (NaN, infinity).
    """
    text = json.dumps(values, indent=1, allow_nan=False, default=str) + "\n"
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


def read_text(path: Path | str) -> str:
    """Read a text file.

    Raises:
        ValueError: when it is absent or no UTF-8.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"cannot read {path}: it is no text in UTF-8 ({error.reason} at byte {error.start})") from None


def read_json(path: Path | str) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        ValueError: when it is absent, no text, no JSON or no object.
    """
    try:
        held = json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"cannot read {path} as JSON: {error}") from None
    if not isinstance(held, dict):
        raise ValueError(f"{path} should hold a JSON object, got {type(held).__name__}")
    return held


def encoded(suffix: str, image: np.ndarray, options: tuple[int, ...] = ()) -> bytes:
    """Return a picture (H, W) or (H, W, 3), red first, as the bytes of a file with this suffix.

    Raises:
        ValueError: when it cannot be encoded so.
    """
    stored = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    try:
        done, data = cv2.imencode(suffix, stored, list(options))
    except cv2.error as error:
        raise ValueError(f"cannot encode {image.shape} {image.dtype} as {suffix}: {error.err}") from None
    if not done:
        raise ValueError(f"cannot encode {image.shape} {image.dtype} as {suffix}")
    return data.tobytes()


def write_picture(path: Path | str, image: np.ndarray, options: tuple[int, ...] = ()) -> None:
    """Write a picture (H, W) or (H, W, 3), red first, by the suffix of ``path``, whole or not at all.

    Args:
        path: where to.
        image: (H, W) or (H, W, 3).
        options: of OpenCV's encoder.

    Raises:
        ValueError: when it cannot be encoded so.
        OSError: when it cannot be written.
    """
    data = encoded(Path(path).suffix.lower(), image, options)
    with written_whole(path) as part:
        part.write_bytes(data)


def write_exr(path: Path | str, channels: Mapping[str, np.ndarray]) -> None:
    """Write channels (H, W) of one float type as an OpenEXR picture, whole or not at all.

    Raises:
        OSError: when it cannot be written.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with written_whole(path) as part:
        try:
            OpenEXR.File(header, {name: np.ascontiguousarray(c) for name, c in channels.items()}).write(str(part))
        except RuntimeError as error:  # a full disk, too
            raise OSError(f"cannot write {path}: {error}") from None


def read_rgb(path: Path | str) -> np.ndarray:
    """Read a colour picture (PNG, JPEG, TIFF, BMP, WebP or a .npy array) as its pixels are stored.

    A picture with an EXIF orientation is turned as that says, with a warning: depth must lie as the picture is shown.

    Returns:
        (H, W, 3) uint8, red first.

    Raises:
        ValueError: for anything but 8 bits in three channels. Grey and RGBA pictures are refused, not guessed at.
    """
    image = read_array(path, turn=True)
    if image.ndim == 2:
        raise ValueError(
            f"{path} is a grey picture {image.shape}: expected RGB (H, W, 3); was a depth map or mask given?"
        )
    if image.ndim == 3 and image.shape[2] == 4:
        raise ValueError(f"{path} has four channels (RGBA): expected RGB (H, W, 3); save it without the alpha channel")
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"{path} should hold RGB as (H, W, 3) uint8, got {image.shape} {image.dtype}")
    return image


def read_depth(path: Path | str, depth_scale: float | None = None, allow_empty: bool = False) -> np.ndarray:
    """Read a depth map; NaN, infinite, negative and absurd readings, and integers 65535, become 0 (missing).

    Args:
        path: PNG or TIFF of 16 bits, .npy of integers or floats, TIFF of floats, .exr.
        depth_scale: metres per unit; None for millimetres (0.001) where the file holds integers, metres (1) where
            floats.
        allow_empty: accept a map without a single valid reading.

    Returns:
        (H, W) float32 metres, 0 = missing.

    Raises:
        ValueError: for an 8-bit or colour picture, another format, a map that holds no valid reading, one whose
            readings are no metres at this scale, or one with swapped bytes.
    """
    return read_depth_and_unit(path, depth_scale, allow_empty)[0]


def read_depth_and_unit(
    path: Path | str, depth_scale: float | None = None, allow_empty: bool = False
) -> tuple[np.ndarray, float]:
    """Do as :func:`read_depth`, and also return the metres per unit in which whole numbers that came leave again.

    That is the unit in which they came; of floats, millimetres.
    """
    if depth_scale is not None and not (np.isfinite(depth_scale) and depth_scale > 0):
        raise ValueError(f"depth_scale should be metres per unit, e.g. 0.001 for millimetres, got {depth_scale!r}")
    raw = read_array(path)
    if raw.dtype != np.uint8:  # of 8 bits, three channels are a colour picture, even a grey one
        raw = one_channel(raw)
    if raw.ndim != 2:
        raise ValueError(f"{path} should hold one depth channel (H, W), got {raw.shape}: was the colour picture given?")
    if raw.dtype == np.uint8 or raw.dtype == bool:
        raise ValueError(
            f"{path} has 8 bits a pixel: expected a 16-bit depth PNG (millimetres, or another unit by depth_scale)"
        )
    if raw.dtype.kind not in "uif":
        raise ValueError(f"{path} should hold integers or floats, got {raw.dtype}")
    whole = raw.dtype.kind in "ui"
    default = MILLIMETRES if whole else 1.0
    scale = default if depth_scale is None else depth_scale
    if whole:
        _refuse_swapped(path, raw)
    metres = _scaled(raw, scale)
    del raw
    check_unit(str(path), metres, scale)
    depth = metres if is_clean(metres) else clean_depth(metres)
    if not allow_empty and not depth.any():
        raise ValueError(f"{path} holds no valid depth: all pixels are 0, negative or not finite")
    return depth, scale if whole else MILLIMETRES


def _scaled(raw: np.ndarray, scale: float) -> np.ndarray:
    """Return stored depth (H, W) in metres, float32; integers 65535 become 0."""
    if raw.dtype == np.float32 and scale == 1:
        return raw
    metres = np.empty(raw.shape, np.float32)
    for row, stored in zip(metres, raw, strict=True):  # a row at a time: float64 is twice as large
        with np.errstate(over="ignore", invalid="ignore"):
            row[:] = stored.astype(np.float64) * scale
        if raw.dtype.kind in "ui":  # before the scale: at 0.25 mm a unit 65535 would be a believable 16.4 m
            row[stored == NO_READING] = 0
    return metres


def one_channel(image: np.ndarray) -> np.ndarray:
    """Return (H, W) of a picture whose channels are one, or repeat each other (a fourth is transparency)."""
    if image.ndim == 3 and image.shape[2] in (1, 3, 4) and (image[..., :3] == image[..., :1]).all():
        return image[..., 0]
    return image


def _refuse_swapped(path: Path | str, raw: np.ndarray) -> None:
    """Refuse 16-bit depth whose two bytes are swapped: neighbours differ wildly, and hardly when swapped back."""
    if raw.dtype.itemsize != 2 or raw.shape[1] < 2:
        return
    some = raw[:: 1 + raw.size // JUDGED]  # rows of a large map
    both = (some[:, 1:] != 0) & (some[:, :-1] != 0)
    if both.sum() < 16:
        return
    steps = [np.abs(np.diff(a.astype(np.int64), axis=1))[both].mean() for a in (some, some.byteswap())]
    if steps[0] > SWAPPED * max(steps[1], 1):
        raise ValueError(f"{path} holds depth with its two bytes swapped: write it with the other byte order")


def read_mask(path: Path | str) -> np.ndarray:
    """Read a mask: a picture of 0 and 255 (cut at 100), of 0 and 1, of 0 and 65535, or a boolean .npy.

    Returns:
        (H, W) bool.

    Raises:
        ValueError: for a colour picture or for values that are neither of these kinds, as those of labels.
    """
    mask = read_labels(path)
    if mask.dtype == bool:
        return mask
    low, top = int(mask.min()), int(mask.max())
    if low < 0:
        raise ValueError(f"{path} should be a mask of 0 and 255 (or 0 and 1), but its smallest value is {low}")
    if top == NO_READING and mask.dtype == np.uint16:
        mask, top = mask // 257, 255
    if 1 < top < MASK_LEVEL or top > 255:
        raise ValueError(
            f"{path} should be a mask of 0 and 255 (or 0 and 1), but its largest value is {top}: of a picture of "
            "labels, save where they are glass or metal"
        )
    if top > 1 and _has_areas_between(mask.astype(np.uint8)):
        raise ValueError(
            f"{path} should be a mask of 0 and 255 (or 0 and 1), but it has areas of other values, as a picture of "
            "labels has: save where they are glass or metal"
        )
    return mask > 0 if top <= 1 else mask >= MASK_LEVEL


def _has_areas_between(mask: np.ndarray) -> bool:
    """Return whether values between 0 and the largest fill areas; those of soft edges differ from their neighbours."""
    between = (mask > 0) & (mask < mask.max())
    around = np.ones((3, 3), np.uint8)
    inner = between & (cv2.erode(mask, around) == cv2.dilate(mask, around))
    return 2 * int(inner.sum()) > int(between.sum())


def read_labels(path: Path | str) -> np.ndarray:
    """Read a picture of whole numbers, one channel; equal channels count as one, a coloured palette by its indices.

    Of grey with transparency, or equal channels with it, whichever of the two is not the same everywhere is taken.

    Returns:
        (H, W) bool or integer.

    Raises:
        ValueError: when channels differ or values are not whole numbers.
    """
    labels = read_array(path, indices=True)
    if labels.ndim == 3 and labels.shape[2] in (2, 4):
        grey, alpha = labels[..., :-1], labels[..., -1]
        labels = grey if (alpha == alpha.flat[0]).all() else labels
        labels = alpha if labels is not grey and (grey == grey.flat[0]).all() else labels
    labels = one_channel(labels)
    if labels.dtype.kind == "f" and labels.ndim == 2 and np.isin(labels, (0, 1)).all():
        labels = labels > 0
    if labels.ndim != 2 or labels.dtype.kind not in "bui":
        raise ValueError(f"{path} should be one channel of whole numbers (H, W), got {labels.shape} {labels.dtype}")
    return labels


def write_depth(path: Path | str, depth_m: np.ndarray, depth_scale: float = MILLIMETRES) -> None:
    """Write a depth map as 16-bit PNG, or as .tif, .npy or .exr (float32 metres), by the suffix of ``path``.

    Args:
        path: where to.
        depth_m: (H, W) float, metres, 0 = missing.
        depth_scale: metres per unit of the PNG: readings that came in this unit leave as they came.

    Raises:
        ValueError: for another suffix, a map that is not finite, 2-D and non-negative, or too far for a PNG.
    """
    path, depth_m = Path(path), check_metres(depth_m)
    suffix = path.suffix.lower()
    if suffix not in DEPTH:
        raise ValueError(f"cannot write depth as {path.suffix or path.name!r}: choose {', '.join(DEPTH)}")
    metres = np.ascontiguousarray(depth_m, dtype=np.float32)
    if suffix == ".exr":
        return write_exr(path, {"R": metres})
    if suffix == ".png":
        if depth_m.max(initial=0) > (NO_READING - 0.5) * depth_scale:  # the last unit means: nothing read
            raise ValueError(
                f"depth reaches {depth_m.max():.1f} m, a 16-bit PNG of {1000 * depth_scale:g} mm a unit ends at "
                f"{NO_READING * depth_scale:.1f}: use .npy"
            )
        data = encoded(".png", depth_to_png(depth_m, depth_scale))
    elif suffix == ".npy":
        np.save(buffer := BytesIO(), metres)
        data = buffer.getvalue()
    else:
        data = encoded(suffix, metres)
    with written_whole(path) as part:
        part.write_bytes(data)


def read_array(path: Path | str, indices: bool = False, turn: bool = False) -> np.ndarray:
    """Read .npy, .exr or a picture as it is stored; colours come red first.

    Args:
        path: of the file; what it is, its first bytes say.
        indices: return the indices of a picture with a coloured palette, not its colours.
        turn: apply an EXIF orientation, with a warning; otherwise a picture that has one is refused.

    Raises:
        ValueError: when the file is absent, empty, damaged, cut short or of an unknown kind, or holds no pixel.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    data = path.read_bytes()
    if path.suffix.lower() == ".npy" or data.startswith(NPY_MAGIC):
        array = _npy(path, data)
    elif path.suffix.lower() == ".exr" or data.startswith(EXR_MAGIC):
        array = _exr(path, data)
    else:
        array = _picture(path, data, indices, turn)
    if not array.size:
        raise ValueError(f"{path} holds no pixel: its shape is {array.shape}")
    return array


def _npy(path: Path, data: bytes) -> np.ndarray:
    """Return the array of a .npy file whose header and length agree."""
    try:
        file = BytesIO(data)
        version = np.lib.format.read_magic(file)
        read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
        shape, _, dtype = read_header[min(version[0], 2)](file)
        if dtype.hasobject:
            raise ValueError("it holds Python objects")
        expected = dtype.itemsize * int(np.prod(shape, dtype=object))
        if len(data) - file.tell() < expected:
            raise ValueError(f"cut short: {len(data) - file.tell()} bytes of {expected}")
        return np.load(BytesIO(data), allow_pickle=False)
    except Exception as error:  # a damaged header raises what its damage leads to: SyntaxError, TypeError, ...
        raise ValueError(f"cannot read {path}: not a plain .npy array ({error})") from None


def _picture(path: Path, data: bytes, indices: bool, turn: bool) -> np.ndarray:
    """Return the pixels of a picture file after checking that it is whole."""
    ros = data[ROS_HEADER.size :].startswith(PNG_MAGIC) and not data.startswith(PNG_MAGIC)
    body = data[ROS_HEADER.size :] if ros else data
    kinds = "a PNG, JPEG, TIFF (of integers or float32, not float64), .npy (no .npz) or .exr file"
    unreadable = f"cannot read {path}: expected {kinds}, this is none or is cut short"
    Image.init()  # all kinds: by itself Pillow tries only the commonest when it is told which to try
    try:
        with warnings.catch_warnings(), _quiet():
            warnings.simplefilter("ignore")  # of Pillow, about large pictures: refused below
            with Image.open(BytesIO(body), formats=KINDS) as held:
                kind, mode, size, pages = held.format, held.mode, held.size, getattr(held, "n_frames", 1)
                orientation = held.getexif().get(ORIENTATION, 1)
                palette = mode == "P" and _coloured(held.getpalette())
                huge = size[0] * size[1] > MAX_PIXELS
                if not huge and (kind == "TIFF" or (indices and mode in ("P", "LA") and (palette or mode == "LA"))):
                    array = np.asarray(held).copy()
                else:
                    array = None
    except Exception:  # a damaged header raises what its damage leads to
        raise ValueError(unreadable) from None
    if huge:
        raise ValueError(f"{path} claims {size[0]} x {size[1]} pixels, more than any camera has")
    if mode in ("CMYK", "YCbCr", "LAB"):
        raise ValueError(f"{path} holds colours as {mode}: save it as RGB")
    if kind == "TIFF" and pages > 1:
        raise ValueError(f"{path} holds {pages} pictures: expected one; save the one that is meant by itself")
    if array is None:
        array = _decoded(kind, body)
    if array is None:
        raise ValueError(unreadable)
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if ros:
        array = _ros_depth(array, ROS_HEADER.unpack(data[: ROS_HEADER.size]))
    if orientation in range(2, 9):  # Pillow has turned a TIFF by itself
        _check_turn(path, orientation, turn)
        array = array if kind == "TIFF" else _turned(array, orientation)
    return array


def _decoded(kind: str, data: bytes) -> np.ndarray | None:
    """Return the pixels of a whole picture, red first; None of one that is damaged or cut short."""
    if kind == "PNG":
        data = _whole_png(data)
    if kind in ("JPEG", "MPO") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        data = b""  # no end after the last scan begins
    if not data:
        return None
    try:  # from bytes: cv2.imread cannot open non-ASCII paths on Windows
        with _quiet():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if image is None or (kind == "PPM" and len(data) < image.nbytes):
        return None
    if image.ndim == 3:  # in place: red first
        code = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}[image.shape[2]]
        cv2.cvtColor(image, code, dst=image)
    return image


def _whole_png(data: bytes) -> bytes:
    """Return a PNG with the chunks that make its pixels only; nothing where one is damaged or the end is missing."""
    kept, at = [PNG_MAGIC], len(PNG_MAGIC)
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 12 + length
        chunk = data[at:end]
        if len(chunk) < 12 + length or zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big"):
            return b""
        if kind in PNG_CHUNKS:
            kept.append(chunk)
        if kind == b"IEND":
            return b"".join(kept)
        at = end
    return b""


def _coloured(palette: list[int] | None) -> bool:
    """Return whether a palette holds colours, so that indices are what a mask means by it."""
    colours = np.array(palette or [0, 0, 0]).reshape(-1, 3)
    return bool((colours != colours[:, :1]).any())


def _ros_depth(raw: np.ndarray, header: tuple[int, float, float]) -> np.ndarray:
    """Return depth of ROS's compressedDepth: millimetres as stored, or metres from quantised inverse depth."""
    _, a, b = header
    if not a:
        return raw
    return np.where(raw > 0, a / np.maximum(raw.astype(np.float64) - b, 1e-9), 0).astype(np.float32)


def _check_turn(path: Path, orientation: int, turn: bool) -> None:
    """Refuse a picture that its EXIF orientation turns, or warn of it where that is allowed."""
    if not turn:
        raise ValueError(f"{path} is to be turned by its EXIF orientation {orientation}: save its pixels as shown")
    warnings.warn(f"{path} was turned as its EXIF orientation {orientation} says: is depth, too?", stacklevel=2)


def _turned(image: np.ndarray, orientation: int) -> np.ndarray:
    """Return a picture as its EXIF orientation, 2 to 8, says that it is to be shown."""
    if orientation >= 5:
        image = np.swapaxes(image, 0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep off the terminal what a library prints: what is wrong with a file, our own message says.

    The standard streams are the whole process's: of several threads one at a time may exchange them.
    """
    with STREAMS, ExitStack() as undo:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        nowhere = undo.enter_context(open(os.devnull, "w"))
        for number in (1, 2):
            copy = os.dup(number)
            undo.callback(os.close, copy)
            undo.callback(os.dup2, copy, number)
            os.dup2(nowhere.fileno(), number)
        undo.enter_context(redirect_stdout(StringIO()))  # what its Python half prints
        undo.enter_context(redirect_stderr(StringIO()))
        yield


def _exr(path: Path, data: bytes) -> np.ndarray:
    """Return the depth or the one channel of an EXR file: Z where there is one; R, if G and B repeat it."""
    if not data.startswith(EXR_MAGIC):  # checked here: the library prints to stderr before it raises
        raise ValueError(f"cannot read {path}: not an OpenEXR file")
    try:
        with _quiet():
            channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except Exception as error:  # of a damaged file, whatever its damage leads to
        raise ValueError(f"cannot read {path}: {error}") from None
    arrays = {name: channel.pixels for name, channel in channels.items()}
    deep = [name for name in arrays if name.rpartition(".")[2] == "Z"]
    if len(deep) == 1:
        return arrays[deep[0]]
    if len(arrays) == 1:
        return next(iter(arrays.values()))
    if "R" not in arrays:
        raise ValueError(f"{path} has channels {sorted(arrays)}: expected one channel, Z or R")
    if any(not np.array_equal(arrays["R"], arrays[c], equal_nan=True) for c in "GB" if c in arrays):
        raise ValueError(f"{path} has channels R, G, B that differ: a colour or normals picture, not depth")
    return arrays["R"]


def read_intrinsics(path: Path | str, size: tuple[int, int] | None = None) -> Camera:
    """Read a pinhole camera and check that it can be of its picture.

    Args:
        path: a 3x3 matrix as text or .npy; lines ``fx: ...`` with fx, fy, cx, cy (or RealSense's ppx, ppy) and perhaps
            the picture's size (xres, width or image_width ...); ROS's ``camera_info`` as YAML; the like as JSON.
        size: (height, width) of the picture; needed where the file does not say it, checked where it does.

    Raises:
        ValueError: for a file of another kind, an unknown or contradictory size, a number that is not finite, a
            focal length <= 0, or a matrix that is of another picture or normalised. A centre far from the middle, as
            a crop's is, needs a file that says the picture's size.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    values = _camera_values(path)
    missing = {"fx", "fy", "cx", "cy"} - set(values)
    if missing:
        raise ValueError(f"{path} lacks {', '.join(sorted(missing))}: expected fx, fy, cx and cy in pixels")
    wrong = [f"{key} {value}" for key, value in values.items() if not np.isfinite(value)]
    if wrong:
        raise ValueError(f"{path} should hold finite numbers, got {', '.join(wrong)}")
    if not (values["fx"] > 0 and values["fy"] > 0):
        raise ValueError(f"{path} should have positive focal lengths, got fx {values['fx']}, fy {values['fy']}")
    own = next(((int(values[h]), int(values[w])) for w, h in SIZES if w in values and h in values), None)
    if own is None and size is None:
        raise ValueError(f"{path} does not say its picture's size: pass size=(height, width)")
    if own and size and own != tuple(size):
        raise ValueError(
            f"{path} is for pictures of {own} (height, width), not {tuple(size)}: multiply fx and cx by "
            "the ratio of the widths, fy and cy by that of the heights (Camera.resized)"
        )
    height, width = own or size
    camera = Camera(values["fx"], values["fy"], values["cx"], values["cy"], int(width), int(height))
    _check_camera(path, camera, sized=own is not None)
    return camera


def _check_camera(path: Path, camera: Camera, sized: bool) -> None:
    """Refuse a camera that cannot be of its picture; ``sized``: the file itself says how large that is."""
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"{path} should give a picture's size in pixels, got {camera.width} x {camera.height}")
    across, down = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    focal = (camera.fx / camera.width, camera.fy / camera.width)
    if max(camera.fx, camera.fy, camera.cx, camera.cy) < 5 < camera.width:
        raise ValueError(f"{path} is normalised (fx {camera.fx:g}, cx {camera.cx:g}): multiply by width and height")
    if not sized and not all(CENTRE[0] <= share <= CENTRE[1] for share in (across, down)):
        raise ValueError(
            f"{path} has its centre at ({camera.cx:g}, {camera.cy:g}), which is not near that of a picture of "
            f"{camera.width} x {camera.height}: it is of another size; scale it (Camera.resized). Of a crop, let "
            "the file say the size (width and height)"
        )
    if not all(FOCAL[0] <= share <= FOCAL[1] for share in focal) or not 0.5 <= camera.fx / camera.fy <= 2:
        raise ValueError(
            f"{path} has focal lengths {camera.fx:g} and {camera.fy:g}, which no camera of {camera.width} x "
            f"{camera.height} pixels has: expected pixels, not millimetres"
        )


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


def _camera_values(path: Path) -> dict[str, float]:
    """Return the numbers of a camera file by their names: fx, fy, cx, cy and perhaps the picture's size."""
    if path.suffix.lower() == ".npy":
        return _matrix(path, read_array(path))
    text = read_text(path)
    if text.lstrip().startswith("{"):
        return _of_json(path, read_json(path))
    if ":" in text:
        return _of_yaml(path, text)
    try:
        return _matrix(path, np.loadtxt(_rows(text)))
    except ValueError as error:
        raise ValueError(f"cannot read {path} as a 3x3 camera matrix: {error}") from None


def _of_yaml(path: Path, text: str) -> dict[str, float]:
    """Return the ``name: number`` lines of a file and its matrix; all that a camera file needs of YAML."""
    text = "\n".join(line.partition("#")[0].rstrip() for line in text.splitlines())
    text = re.sub(r"^([ \t]*)roi[ \t]*:\n(?:\1[ \t]+.*(?:\n|\Z))+", "", text, flags=re.MULTILINE)  # ROS: 0 x 0, a part
    values: dict[str, float] = {}
    for key, value in re.findall(r"^[ \t]*([\w ]+?)[ \t]*:[ \t]*([-+.\w]+)[ \t,]*$", text, re.MULTILINE):
        try:
            read = float(value)
        except ValueError:
            continue  # a heading, a camera's name
        key = CENTRES.get(key.lower(), key.lower())
        if key in ("fx", "fy", "cx", "cy") and key in values and values[key] != read:
            raise ValueError(f"{path} holds several cameras: keep the one of the colour picture")
        values[key] = read
    number = r"[-+.\deE]+"
    for pattern in (
        r"camera_matrix\s*:[^\[]*?data\s*:\s*\[([^\]]*)\]",
        r"^\s*[Kk]\s*:\s*\[([^\]]*)\]",
        rf"^\s*[Kk]\s*:\s*\n((?:\s*-\s+{number}\s*\n?){{9}})",
    ):
        found = re.findall(pattern, text, re.MULTILINE)
        if not found or {"fx", "fy"} <= set(values):
            continue
        if len(set(found)) > 1:
            raise ValueError(f"{path} holds several cameras: keep the one of the colour picture")
        entries = [float(word) for word in re.findall(rf"(?<![\w.]){number}", found[0].replace("- ", " "))]
        if len(entries) != 9:
            raise ValueError(f"{path} should hold a 3x3 camera matrix, got {len(entries)} numbers")
        values |= _matrix(path, np.array(entries).reshape(3, 3))
    return {key: value for key, value in values.items() if _known(key)}


def _of_json(path: Path, held: dict[str, Any]) -> dict[str, float]:
    """Return the numbers of the one camera that a JSON object holds, however deep."""
    cameras = [found for found in map(lambda node: _of_node(path, node), _objects(held)) if found]
    if len(cameras) > 1:
        raise ValueError(f"{path} holds {len(cameras)} cameras: keep the one of the colour picture")
    return cameras[0] if cameras else {}


def _objects(node: Any) -> Iterator[dict[str, Any]]:
    """Yield all objects in a JSON value."""
    if isinstance(node, dict):
        yield node
    for inner in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from _objects(inner)


def _of_node(path: Path, node: dict[str, Any]) -> dict[str, float]:
    """Return the camera that one JSON object describes itself, or nothing."""
    lower = {str(key).lower(): value for key, value in node.items()}
    lower = {CENTRES.get(key, key): value for key, value in lower.items()}
    numbers = {key: value for key, value in lower.items() if isinstance(value, int | float) and _known(key)}
    for key in MATRICES:
        given = lower.get(key)
        if isinstance(given, dict):
            given = given.get("data")
        if not isinstance(given, list):
            continue
        try:
            k = np.array(given, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(f"{path} should hold numbers as {key!r}, got {given!r}") from None
        if k.size == 9:
            k = k.reshape(3, 3)
            numbers |= _matrix(path, k.T if k[2, 0] or k[2, 1] else k)  # Open3D writes it column by column
    return {key: float(value) for key, value in numbers.items()} if "fx" in numbers else {}


def _known(key: str) -> bool:
    return key in ("fx", "fy", "cx", "cy") or any(key in pair for pair in SIZES)


def _matrix(path: Path, k: np.ndarray) -> dict[str, float]:
    if k.shape != (3, 3) or k.dtype.kind not in "uif" or not np.allclose(k[2], [0, 0, 1]):
        raise ValueError(f"{path} should hold a 3x3 camera matrix with last row 0 0 1, got shape {k.shape}")
    return {"fx": float(k[0, 0]), "fy": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}


def _rows(text: str) -> list[str]:
    """Return the lines of a file of numbers, without commas and comments."""
    lines = (line.partition("#")[0].replace(",", " ").strip() for line in text.splitlines())
    rows = [line for line in lines if line]
    if not rows:  # NumPy would warn and return an empty array
        raise ValueError("it holds no numbers")
    return rows
