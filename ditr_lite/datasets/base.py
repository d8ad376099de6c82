"""What all readers of real datasets share: a lazy list of frames in a folder, and which pixels can teach what.

A reader looks for file names when made, reads a frame when indexed, holds no open file and can be sent to another
process, so ``torch.utils.data.DataLoader`` takes it as it is. Nothing is downloaded.
"""

import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..data import Sample
from ..files import read_array
from ..units import looks_swapped, typical_ratio


class FrameFolder:
    """A folder of frames, found by the file that holds the raw depth.

    Args:
        root: the dataset's folder, or any folder inside it that holds frames.
        split: keep only the frames of this split; None keeps all.

    Raises:
        ValueError: for a root or split without frames; the message gives the layout that was looked for.
    """

    layout = ""  # for the message
    frame: str | tuple[str, ...] = ""  # glob, or globs, of the raw depth files ...
    suffix = ""  # ... and what is cut off to make the frame's name
    splits: tuple[str, ...] = ()
    protocol = ""  # how the paper trains and tests on it, and what to keep in mind

    def __init__(self, root: Path | str, split: str | None = None):
        self.root, self.split = Path(root), split
        if split is not None and split not in self.splits:
            known = (
                f"choose {', '.join(self.splits)}, or none for all" if self.splits else "it has no splits: give none"
            )
            raise ValueError(f"unknown split {split!r} of {type(self).__name__}; {known}")
        globs = (self.frame,) if isinstance(self.frame, str) else self.frame
        found = [path for glob in globs for path in self.find(glob)] if self.root.is_dir() else []
        found = [path for path in found if not is_hidden(path, self.root)]
        if self.suffix.startswith("/"):  # a frame is a folder, named by its place below the root: the root is none
            found = [path for path in found if path.parent != self.root]
        names = (path.relative_to(self.root).as_posix().removesuffix(self.suffix) for path in found)
        self.names = sorted(name for name in names if split is None or self.in_split(name))
        if not self.names:
            which = f" of split {split!r}" if split else ""
            raise ValueError(f"no {type(self).__name__} frames{which} in {self.root}: expected {self.layout}")

    def find(self, glob: str) -> Iterable[Path]:
        """Return the files below the root that a glob describes, however deep."""
        return self.root.rglob(glob)

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
        try:
            sample = self.read(name, self.root / name)
        except (KeyError, TypeError, IndexError, AttributeError) as error:  # of a description with odd entries
            kind = type(self).__name__
            raise ValueError(f"{name} in {self.root} holds other things than a frame of {kind}: {error!r}") from None
        for key in ("depth", "depth_gt", "region"):
            array = getattr(sample, key)
            if array is not None and array.shape != sample.rgb.shape[:2]:
                raise ValueError(f"{name}: {key} is {array.shape}, the colour picture {sample.rgb.shape[:2]}")
        known = sample.depth_gt is not None and sample.region is not None
        if known and looks_swapped(sample.depth, sample.depth_gt, sample.region):
            warnings.warn(
                f"{self.root}: raw depth and truth look swapped: inside the region the truth shows a sensor's loss",
                stacklevel=2,
            )
        ratio = 1.0 if sample.depth_gt is None else typical_ratio(sample.depth, sample.depth_gt, sample.region)
        if not 0.5 < ratio < 2:
            told = f"raw depth is {ratio:.3g} times the truth"
            warnings.warn(f"{self.root}: {told}: are both in one unit (depth_scale)?", stacklevel=2)
        return sample

    def in_split(self, name: str) -> bool:
        """Return whether the frame belongs to ``self.split``: the nearest folder above it that names one decides.

        So folders above the root count only where none below it names a split: the root may lie inside a split.
        """
        folders = reversed((self.root / name).parts)
        named = (split for folder in folders for split in self.splits if self.is_called(folder, split))
        return next(named, None) == self.split

    def is_called(self, folder: str, split: str) -> bool:
        """Return whether a folder of this name holds frames of a split."""
        return folder == split

    def files(self, names: Sequence[str]) -> list[list[Path]]:
        """Return, for each of the frames, the files that its maps are read from; an optional one need not be there."""
        return [self.files_of(self.root / name) for name in names]

    def files_of(self, stem: Path) -> list[Path]:
        """Return the files that a frame's maps are read from; ``stem`` as for :meth:`read`."""
        raise NotImplementedError

    def read(self, name: str, stem: Path) -> Sample:
        """Read one frame; ``stem`` is its path without what differs from file to file."""
        raise NotImplementedError


def teachable(sample: Sample) -> dict[str, np.ndarray]:
    """Return on which pixels a frame can train each branch, two (H, W) bool masks.

    ``optical``: inside the region, where the truth is known. ``geometric``: outside it, where the sensor read nothing
    and the truth is known; a reading that is there needs no repair and teaches none. Without truth both are empty.

    Paper: Sec. V-C excludes "the pixels with missing depth from the area to be inpainted" and trains the geometric
    branch on STD, because ClearGrasp lacks ground truth outside the masks.
    """
    region = np.zeros(sample.depth.shape, bool) if sample.region is None else sample.region
    truth = np.zeros_like(sample.depth) if sample.depth_gt is None else sample.depth_gt
    known = truth > 0
    return {"optical": region & known, "geometric": ~region & known & (sample.depth == 0)}


def is_hidden(path: Path, root: Path) -> bool:
    """Return whether a file below ``root``, or a folder that it is in, has a name with a dot in front."""
    return any(part.startswith(".") for part in path.relative_to(root).parts)


def beside(stem: Path, suffix: str) -> Path:
    """Return the file of a frame that ends in ``suffix``."""
    return stem.with_name(stem.name + suffix)


def red(path: Path) -> np.ndarray:
    """Return the labels of a picture that keeps them in its red channel, or in its only one."""
    labels = read_array(path)
    return labels if labels.ndim == 2 else labels[..., 0]
