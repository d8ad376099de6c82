"""What several evaluations are tested with."""

import pytest

from ditr_lite import pipeline
from ditr_lite.config import preset


@pytest.fixture(scope="module")
def tiny():
    """An untrained system: what it predicts is no matter, that every evaluation works is."""
    return pipeline.Ditr(pipeline.build(preset("tiny")), preset("tiny"))
