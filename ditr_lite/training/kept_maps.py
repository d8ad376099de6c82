"""Boundary maps kept by content: of pictures that are looked at again and again, as validation frames are.

It pays for slow backends on pictures that do not change: a network, SAM above all. Training itself varies every picture
anew, so neither its maps nor its latents are ever asked for twice; the classical backend is as fast as the disk.
"""

import hashlib
from pathlib import Path

import numpy as np

from ..boundary import Backend
from ..files import written_whole

FOLDER = Path("outputs/cache/maps")
SLOW = ("learned", "sam")  # backends whose maps are worth keeping


class KeptMaps:
    """A boundary backend that finds each map once.

    Args:
        backend: asked where a map is not known; its ``fingerprint`` says on what its maps depend.
        folder: for the maps, a bit a pixel.
    """

    def __init__(self, backend: Backend, folder: Path | str = FOLDER):
        self.backend, self.folder = backend, Path(folder)
        self.about = str(backend.fingerprint)

    @property
    def fingerprint(self) -> str:
        """That of the backend."""
        return self.about

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return (H, W) bool for an image, as the backend does."""
        image = np.ascontiguousarray(image)
        digest = hashlib.sha256(f"{self.about} {image.dtype} {image.shape}".encode())
        digest.update(image.view(np.uint8))
        name = digest.hexdigest()[:32]
        path = self.folder / name[:2] / f"{name}.npy"
        pixels = image.shape[0] * image.shape[1]
        if path.is_file():
            bits = np.load(path)
            if bits.dtype == np.uint8 and bits.size == -(-pixels // 8):
                return np.unpackbits(bits, count=pixels).astype(bool).reshape(image.shape[:2])
        found = self.backend(image)
        with written_whole(path) as part:
            np.save(part, np.packbits(found))
        return found
