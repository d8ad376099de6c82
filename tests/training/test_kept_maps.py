import numpy as np
import pytest

from ditr_lite.boundary import ClassicalBoundary
from ditr_lite.training import parts
from ditr_lite.training.kept_maps import KeptMaps

CALLS = []  # not of the object, whose variables its fingerprint lists


class Counting(ClassicalBoundary):
    def __call__(self, image):
        CALLS.append(image.shape)
        return super().__call__(image)


@pytest.fixture(autouse=True)
def no_calls():
    CALLS.clear()


def pictures():
    rng = np.random.default_rng(0)
    depth = np.where(np.arange(30)[:, None] > 13, 0.5, 0.9) + np.zeros((30, 41))
    return [rng.integers(0, 255, (30, 41, 3), np.uint8), depth.astype(np.float32)]


def test_a_map_is_found_once_and_is_the_backends(tmp_path):
    backend = Counting()
    for _ in range(2):  # a second object, as in another run
        kept = KeptMaps(backend, tmp_path)
        for image in pictures():
            assert np.array_equal(kept(image), ClassicalBoundary()(image))
    assert len(CALLS) == 2 and kept.fingerprint == str(backend.fingerprint)


@pytest.mark.parametrize("change", ["pixel", "settings"])
def test_other_content_or_other_settings_are_another_map(tmp_path, change, monkeypatch):
    backend, image = Counting(), pictures()[1]
    KeptMaps(backend, tmp_path)(image)
    if change == "pixel":
        image[3, 3] += 0.01
    else:
        monkeypatch.setattr(Counting, "fingerprint", "other")
    KeptMaps(backend, tmp_path)(image)
    assert len(CALLS) == 2


@pytest.mark.parametrize("damage", ["cut", "empty", "a bit of the map", "a bit of the checksum"])
def test_a_damaged_map_is_found_anew(tmp_path, damage):
    backend, image = Counting(), pictures()[1]
    KeptMaps(backend, tmp_path)(image)
    [file] = (path for path in tmp_path.rglob("*") if path.is_file())
    data = bytearray(file.read_bytes())
    if damage.startswith("a bit"):
        data[-1 if damage.endswith("map") else 0] ^= 4
    else:
        del data[len(data) // 2 if damage == "cut" else 0 :]
    file.write_bytes(data)
    for _ in range(2):  # the second time as it was written again
        assert np.array_equal(KeptMaps(backend, tmp_path)(image), ClassicalBoundary()(image)) and len(CALLS) == 2


def test_validation_keeps_the_maps_of_slow_backends(monkeypatch):
    seen = []
    monkeypatch.setattr(parts, "frames_in_order", lambda scenes, size, backend: seen.append(type(backend)))
    monkeypatch.setattr(parts, "get_backend", lambda name: Counting())
    for name in ("classical", "sam", "none"):
        parts.held_out_batches("geometric", None, parts.Config(), name)
    assert seen == [Counting, KeptMaps, Counting]
