"""Boundary maps kept by content: of pictures that are looked at again and again, as validation frames are.

It pays for slow backends on pictures that do not change: a network, SAM above all. Training itself varies every picture
anew, so neither its maps nor its latents are ever asked for twice; the classical backend is as fast as the disk.
"""

import hashlib
import zlib
from pathlib import Path

import numpy as np

from ..boundary import Backend
from ..files import written_whole

CRC = 4  # bytes in front of a map
FOLDER = Path("outputs/cache/maps")
SLOW = ("learned", "sam")  # backends whose maps are worth keeping


class KeptMaps:
    """A boundary backend that finds each map once.

    Args:
        backend: asked where a map is not known; its ``fingerprint`` says on what its maps depend.
        folder: for the maps, a bit a pixel, each with a checksum: a damaged one is found anew.
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
        path = self.folder / name[:2] / f"{name}.bits"
        found = _read(path, image.shape[:2])
        if found is None:
            found = self.backend(image)
            bits = np.packbits(found).tobytes()
            with written_whole(path) as part:
                part.write_bytes(zlib.crc32(bits).to_bytes(CRC) + bits)
        return found


def _read(path: Path, shape: tuple[int, int]) -> np.ndarray | None:
    """Return the map of a file, None where there is none or it is damaged."""
    if not path.is_file():
        return None
    stored = path.read_bytes()
    bits, pixels = stored[CRC:], shape[0] * shape[1]
    if len(bits) != -(-pixels // 8) or stored[:CRC] != zlib.crc32(bits).to_bytes(CRC):
        return None
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=pixels).astype(bool).reshape(shape)
