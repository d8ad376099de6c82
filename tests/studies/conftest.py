"""What several studies are tested with."""

import pytest

from ditr_lite import pipeline
from ditr_lite.config import preset


@pytest.fixture(scope="module")
def tiny():
    """An untrained system: what it predicts is no matter, that every run works is."""
    config = preset("tiny")
    return pipeline.Ditr(pipeline.build(config), config)
