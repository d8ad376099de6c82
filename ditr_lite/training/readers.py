"""Frames of real datasets as scenes to train on: any reader of ``datasets``, with the protocol of the paper.

Paper: Sec. V-C. A frame teaches a part only where its truth is known: the optical branch inside the region, the
geometric one in holes outside it; a frame that teaches a part nothing is left out for that part. The paper also sets
the readings inside the region to zero; that is ``zero_region`` (where the preset shows no evidence, the branches never
see them anyway).

Frames are decoded once and kept as memory-mapped arrays, at most twice the working size, so that a hundred thousand of
them need no memory and any number of workers share them. The kept arrays are known by the dataset's frames, the sizes
and times of all files that these are read from (but for the camera's: no map depends on it), and the settings: when one
changes they are made again. Every row of them has a checksum, so that what a disk spoils is not learnt.
"""

import hashlib
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from ..config import Config
from ..data import Sample
from ..datasets import REGISTRY, FrameFolder, teachable
from ..files import folder_written_whole
from ..region import IGNORE
from ..windows import fit_frame
from .loop import is_first, wait_for_all
from .scenes import MAPS, Pool, Scenes

CACHE = Path("outputs/cache")
DESCRIPTION = "frames.json"
FARTHEST_MM = 65_535  # of 16 bits; what is farther counts as not read
TEACH = ("region", "truth", "optical", "geometric")  # what a frame may have, one column each
WANTED = {"region": "region", "autoencoder": "truth", "optical": "optical", "geometric": "geometric", "detail": "truth"}


@dataclass(frozen=True)
class RealFrames:
    """Frames of a dataset to train on, and how they are mixed with rendered scenes.

    Attributes:
        name: of the reader, a key of ``datasets.REGISTRY``.
        root: folder of the dataset.
        split: to train on; None takes all.
        val_split: to validate on besides the rendered scenes; None for none, or all of ``val_root``.
        val_root: folder of the same layout that holds the frames to validate on; None for ``root``.
        scene_share: of the draws that come from rendered scenes, 0 to 1.
        zero_region: set the readings inside the region to zero (Paper: Sec. V-C).
        limit: use only the first frames.
        depth_scale: metres per unit of depth, of the reader "folder" alone; None as that reads it.
        cache: folder for the decoded frames.

    Raises:
        ValueError: for an unknown reader, a scale of one that knows its unit, or a share that is none.
    """

    name: str
    root: Path
    split: str | None = None
    val_split: str | None = None
    val_root: Path | None = None
    scene_share: float = 0.0
    zero_region: bool = False
    limit: int | None = None
    depth_scale: float | None = None
    cache: Path = CACHE

    def __post_init__(self) -> None:
        if self.name not in REGISTRY:
            raise ValueError(f"unknown dataset {self.name!r}; choose one of {', '.join(REGISTRY)}")
        scale_of(self.name, self.depth_scale)
        if not 0 <= self.scene_share <= 1:
            raise ValueError(f"expected a share of rendered scenes from 0 to 1, got {self.scene_share}")

    def pool(self, part: str, config: Config, rendered: Sequence[Scenes]) -> Pool:
        """Return what ``part`` draws from: these frames and rendered scenes, at the stated share."""
        real = self.scenes(part, config, self.split)
        if self.scene_share and not rendered:
            raise ValueError(f"a share of {self.scene_share} of rendered scenes needs some: give --data")
        rendered = list(rendered) if self.scene_share else []
        shares = []
        for groups, share in ((real, 1 - self.scene_share), (rendered, self.scene_share)):
            count = sum(len(group) for group in groups)
            shares += [share * len(group) / count for group in groups]
        return Pool([*real, *rendered], shares)

    def held_out(self, part: str, config: Config) -> dict[str, Scenes]:
        """Return name -> frames to validate on, none where neither a split nor a folder is named for it."""
        if self.val_split is None and self.val_root is None:
            return {}
        root = Path(self.val_root or self.root)
        same = self.val_split == self.split or None in (self.val_split, self.split)  # None is all of a dataset
        if same and root.resolve() == Path(self.root).resolve():
            raise ValueError(
                f"frames of {root} are trained on and cannot judge: name another --val-root, or --split and --val-split"
            )
        groups = self.scenes(part, config, self.val_split, root)
        return {f"{self.name}_{self.val_split or root.name}{k or ''}": group for k, group in enumerate(groups)}

    def scenes(self, part: str, config: Config, split: str | None, root: Path | None = None) -> list[Scenes]:
        """Return the frames of a split that can teach ``part``, a group for each size of frame.

        Raises:
            ValueError: where none can.
        """
        root = root or self.root
        reader = REGISTRY[self.name](root, split, **scale_of(self.name, self.depth_scale))
        groups = [_rows_for(part, group) for group in kept(reader, self, config.size)]
        if not (groups := [group for group in groups if len(group)]):
            raise ValueError(
                f"no frame of {self.name} in {root} teaches {part!r}: it needs {_needed(part)}; "
                f"{type(reader).__name__}: {reader.protocol or 'see its reader'}"
            )
        return groups


def scale_of(name: str, depth_scale: float | None) -> dict[str, float]:
    """Return what a reader is told of the unit of depth, nothing where nothing is said.

    Raises:
        ValueError: for a scale of a dataset whose unit is known.
    """
    if depth_scale is None:
        return {}
    if name != "folder":
        raise ValueError(f"--depth-scale is of --dataset folder; the unit of {name} is known")
    return {"depth_scale": depth_scale}


def _needed(part: str) -> str:
    told = {
        "region": "a region",
        "truth": "ground-truth depth and a region",
        "optical": "ground-truth depth inside the region",
        "geometric": "holes outside the region where the ground truth is known",
    }
    return told[WANTED[part]]


@dataclass(frozen=True)
class Kept:
    """Decoded frames of one size.

    Attributes:
        names: of the frames.
        arrays: map -> (N, H, W, ...) on disk.
        checksums: map -> CRC-32 of each row, (N,).
        teach: what each frame can teach, (N, 4) bool.
        key: that stands for their content.
    """

    names: list[str]
    arrays: dict[str, np.memmap]
    checksums: dict[str, np.ndarray]
    teach: np.ndarray
    key: str


class Rows:
    """Some rows of an array that is not in memory, each checked when it is read.

    Args:
        array: all rows, on disk.
        checksums: of all rows.
        index: which rows.
    """

    def __init__(self, array: np.memmap, checksums: np.ndarray, index: np.ndarray):
        self.array, self.checksums, self.index = array, checksums, index
        self.shape, self.dtype = (len(index), *array.shape[1:]), array.dtype

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how another process opens the same file: pickled, a memory map would be a copy of all that it maps."""
        where = (Path(self.array.filename), self.array.dtype, self.array.shape)
        return _reopened, (where, self.checksums, self.index)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.index)

    def __getitem__(self, i: int | slice | np.ndarray) -> Any:
        """Return one row, or those of a slice or of an array of places as :class:`Rows`.

        Raises:
            ValueError: for a row that is not as it was written.
        """
        if isinstance(i, slice | np.ndarray):
            return Rows(self.array, self.checksums, self.index[i])
        place = self.index[i]
        row = np.asarray(self.array[place])
        if zlib.crc32(row) != self.checksums[place]:
            folder = Path(self.array.filename).parent
            raise ValueError(f"a decoded frame in {folder} is damaged: delete that folder, it is then made again")
        return row


def _reopened(where: tuple[Path, np.dtype, tuple[int, ...]], checksums: np.ndarray, index: np.ndarray) -> Rows:
    """Return rows of an array on disk, ``where`` being its file, type and shape."""
    path, kind, shape = where
    return Rows(np.memmap(path, kind, "r", shape=shape), checksums, index)


def _rows_for(part: str, group: Kept) -> Scenes:
    index = np.flatnonzero(group.teach[:, TEACH.index(WANTED[part])])
    rows = {name: Rows(group.arrays[name], group.checksums[name], index) for name in MAPS}
    return Scenes([group.names[i] for i in index], **rows, key=f"{group.key} {part}")


def kept(reader: FrameFolder, how: RealFrames, size: tuple[int, int]) -> list[Kept]:
    """Return the decoded frames of a reader, from the cache or put there now by the first process.

    Args:
        reader: of a split.
        how: name, limit, unit and whether readings inside the region are zeroed.
        size: (H, W) of the system.

    Raises:
        ValueError: in a process that does not see what the first one put there.
    """
    names = reader.names[: how.limit]
    stats = [list(map(_stat, paths)) for paths in reader.files(names)]
    plain = json.dumps([how.name, names, stats, how.zero_region, size, *scale_of(how.name, how.depth_scale).values()])
    key = hashlib.sha256(plain.encode()).hexdigest()[:16]
    folder = Path(how.cache) / f"{how.name}-{key}"
    if is_first() and _described(folder) is None:
        _decode(reader, names, how, size, folder)
    wait_for_all()
    described = _described(folder)
    if described is None:
        raise ValueError(f"the decoded frames in {folder} are not seen by every process: give all the same folder")
    groups = []
    for k, group in enumerate(described):
        shape = (len(group["names"]), *group["size"])
        arrays = {name: _map_file(folder, k, name, shape, "r") for name in MAPS}
        checksums = {name: np.array(group["checksums"][name], np.uint32) for name in MAPS}
        teach = np.array(group["teach"], bool).reshape(-1, len(TEACH))
        groups.append(Kept(group["names"], arrays, checksums, teach, f"{key} {k}"))
    return groups


def _described(folder: Path) -> list[dict[str, Any]] | None:
    """Return what a folder says of its groups, None where it is damaged or not there.

    That its files have their sizes is looked at here, what is in them when it is read.
    """
    try:
        described = json.loads((folder / DESCRIPTION).read_bytes())
        groups = described["groups"]
        if described["sha256"] != _digest(groups):
            return None
        for k, group in enumerate(groups):
            for name in MAPS:
                shape, kind = _stored((len(group["names"]), *group["size"]), name)
                if (folder / f"{k}_{name}.bin").stat().st_size != int(np.prod(shape)) * np.dtype(kind).itemsize:
                    return None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return groups


def _digest(groups: list[dict[str, Any]]) -> str:
    return hashlib.sha256(json.dumps(groups).encode()).hexdigest()


def _stat(path: Path) -> list[int]:
    """Return size and time of a file, nothing of one that is not there."""
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [found.st_size, found.st_mtime_ns]


def _decode(reader: FrameFolder, names: list[str], how: RealFrames, size: tuple[int, int], folder: Path) -> None:
    """Decode frames and write them, a group of arrays for each size."""
    by_shape: dict[tuple[int, int], list[str]] = {}
    for name in tqdm(names, "sizes", unit="frame", leave=False):
        by_shape.setdefault(reader[name].depth.shape, []).append(name)
    with folder_written_whole(folder) as part:
        described = []
        for k, (shape, group) in enumerate(by_shape.items()):
            described.append(_write_group(reader, group, part, k, stored_size(shape, size), how.zero_region))
        (part / DESCRIPTION).write_text(json.dumps({"sha256": _digest(described), "groups": described}))


def _write_group(
    reader: FrameFolder, names: list[str], folder: Path, k: int, size: tuple[int, int], zero_region: bool
) -> dict[str, Any]:
    """Write the maps of group ``k``, frames of one size, and return what is said of it; its files are closed then."""
    arrays = {name: _map_file(folder, k, name, (len(names), *size), "w+") for name in MAPS}
    teach, checksums = [], {name: [] for name in MAPS}
    for i, name in enumerate(tqdm(names, "decoding", unit="frame")):
        maps, row = _maps(reader[name], size, zero_region)
        teach.append(row)
        for key, values in maps.items():
            arrays[key][i] = values
            checksums[key].append(zlib.crc32(arrays[key][i]))
    for array in arrays.values():
        array.flush()
    return {"names": names, "size": size, "teach": teach, "checksums": checksums}


def _map_file(folder: Path, k: int, name: str, shape: tuple[int, int, int], mode: str) -> np.memmap:
    """Return a map of group ``k``, (N, H, W) or, of colours, (N, H, W, 3), as a file that is an array."""
    shape, kind = _stored(shape, name)
    return np.memmap(folder / f"{k}_{name}.bin", kind, mode, shape=shape)


def _stored(shape: tuple[int, int, int], name: str) -> tuple[tuple[int, ...], type]:
    """Return shape and type of a map as it is kept."""
    return (*shape, 3) if name == "rgb" else shape, np.uint16 if name.startswith("depth") else np.uint8


def stored_size(shape: tuple[int, int], size: tuple[int, int]) -> tuple[int, int]:
    """Return the size at which a frame is kept: its own, or smaller, but not below twice the working size."""
    factor = max(1.0, min(shape[0] / (2 * size[0]), shape[1] / (2 * size[1])))
    return round(shape[0] / factor), round(shape[1] / factor)


def _maps(sample: Sample, size: tuple[int, int], zero_region: bool) -> tuple[dict[str, np.ndarray], list[bool]]:
    """Return the maps of a frame at ``size``, and what it can teach."""
    blank = np.zeros(sample.depth.shape, np.uint8)
    depth = sample.depth
    truth = np.zeros_like(depth) if sample.depth_gt is None else sample.depth_gt
    can = {name: bool(mask.any()) for name, mask in teachable(sample).items()}
    has_region = sample.region is not None
    row = [has_region, has_region and bool((truth > 0).any()), can["optical"], has_region and can["geometric"]]
    material = np.full_like(blank, IGNORE) if sample.material is None else sample.material
    instances = blank if sample.instances is None else sample.instances
    frame = fit_frame(depth.shape, size)
    maps = {"rgb": sample.rgb, "depth": depth, "depth_gt": truth, "material": material, "instances": instances}
    maps = {name: image if image.shape[:2] == size else frame.into(image) for name, image in maps.items()}
    if zero_region and has_region:  # at the size at which it is kept: a smaller map takes readings from next door
        maps["depth"] = np.where(frame.into(sample.region), np.float32(0), maps["depth"])
    for name in ("depth", "depth_gt"):
        millimetres = np.rint(maps[name].astype(np.float64) * 1000)
        maps[name] = np.where(millimetres <= FARTHEST_MM, millimetres, 0).astype(np.uint16)
    return maps, row
