import pytest

from ditr_lite.viz.source import excerpt


def sample_function(n):
    total = 0
    for k in range(n):
        total += k
    return total


def test_an_excerpt_is_the_code_itself():
    assert excerpt(sample_function, "for k", "total +=") == "for k in range(n):\n    total += k"


def test_lines_that_are_not_there_are_named():
    with pytest.raises(ValueError, match="no lines from 'for k' to 'total = 0'"):
        excerpt(sample_function, "for k", "total = 0")
