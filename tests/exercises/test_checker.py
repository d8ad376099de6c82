import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ditr_lite import exercises
from ditr_lite.exercises.checker import announce, check

EXERCISES = Path(exercises.__file__).parent


def double(x):
    return 2 * x


INPUTS = [(np.arange(6.0).reshape(2, 3),)]


def run(capsys, attempt, reference=double, inputs=INPUTS, **settings):
    passed = check("doubling", attempt, reference, inputs, **settings)
    out = capsys.readouterr().out
    assert out.startswith("✓ doubling" if passed else "✗ doubling: ") and out.count("\n") == 1
    return passed, out


def test_the_reference_passes(capsys):
    assert run(capsys, lambda x: x + x) == (True, "✓ doubling\n")


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda x: None, "is a `return` missing"),
        (lambda x: (2 * x).T, r"should have shape (2, 3), got (3, 2)"),
        (lambda x: 2 * x + (x == 4), "1 of 6 values differ; at (1, 1) expected 8.0, got 9.0"),
        (lambda x: 2 * x > 3, "should be float64, got bool"),
        (lambda x: np.array([["a"] * 3] * 2), "should be numbers"),
        (lambda x: x / 0, "6 of 6 values differ"),  # and no warning
        (lambda x: np.multiply(x, 2, out=x), "changes its input"),
        (lambda: 1, "TypeError"),
        (lambda x: x[9], "stopped with IndexError"),
        (3, "TypeError"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_is_wrong_is_said_and_nothing_raised(capsys, attempt, message):
    passed, out = run(capsys, attempt)
    assert not passed and message in out


def test_an_exercise_left_alone(capsys):
    def attempt(x):
        raise NotImplementedError

    assert run(capsys, attempt) == (False, "✗ doubling: not attempted yet\n")


def test_a_known_mistake_is_named(capsys):
    mistakes = {
        "cannot be made here": lambda x: x[99],
        "that squares": lambda x: x**2,
        "that adds two": lambda x: x + 2,
    }
    assert "that adds two" in run(capsys, lambda x: 2 + x, mistakes=mistakes)[1]
    assert "values differ" in run(capsys, lambda x: 3 * x, mistakes=mistakes)[1]
    # a mistake must explain every case, or it is not the one
    inputs = [(np.array([2.0, 0.0]),), (np.array([3.0]),)]
    assert "values differ" in run(capsys, lambda x: x**2 + (x == 3), mistakes=mistakes, inputs=inputs)[1]


def halves(x):
    return x[:1], x[1:, 1:]


@pytest.mark.parametrize(
    ("reference", "attempt", "message"),
    [
        (double, halves, "its parts should have the shapes one array, got (1, 3) and (1, 2)"),
        (halves, double, "its parts should have the shapes (1, 3) and (1, 2), got one array"),
        (halves, lambda x: halves(x)[::-1], "shapes (1, 3) and (1, 2), got (1, 2) and (1, 3)"),
        (halves, lambda x: halves(x + (x == 5)), "1 of 2 values differ; at (0, 1) expected 5.0, got 6.0"),
        (halves, lambda x: (halves(x), 3), "its parts should have"),
    ],
)
def test_parts_of_different_shapes_are_compared_and_nothing_stops(capsys, reference, attempt, message):
    passed, out = run(capsys, attempt, reference=reference)
    assert not passed and message in out and "stopped" not in out
    assert run(capsys, reference, reference=reference)[0]


def test_a_mistake_of_different_shapes_is_named(capsys):
    assert "cut apart" in run(capsys, halves, mistakes={"cut apart": halves})[1]


def test_the_kind_of_number_counts_where_it_is_asked_for(capsys):
    inputs = [(np.array([0.5], np.float32),)]
    for attempt, right in ((double, True), (lambda x: 2 * x.astype(float), False)):
        assert run(capsys, attempt, inputs=inputs, dtype=True)[0] == right and run(capsys, attempt, inputs=inputs)[0]


def test_bit_for_bit(capsys):
    x = np.array([0.1, 0.7], np.float32)

    def almost(x):
        return np.nextafter(2 * x, np.float32(9))

    assert run(capsys, almost, inputs=[(x,)])[0]
    assert not run(capsys, almost, inputs=[(x,)], rtol=0)[0]
    assert "should be float32, got float64" in run(capsys, lambda x: 2.0 * x.astype(float), inputs=[(x,)], rtol=0)[1]


def test_verdict_of_a_free_check(capsys):
    assert announce("a", lambda: None) and not announce("b", lambda: "too small")
    assert capsys.readouterr().out == "✓ a\n✗ b: too small\n"


def test_leaving_the_program_is_a_reason_and_a_gradient_no_obstacle(capsys):
    assert not announce("a", lambda: sys.exit(1)) and "stopped with SystemExit: 1" in capsys.readouterr().out
    tensor = torch.ones(2, requires_grad=True)
    assert check("b", lambda x: tensor * 1, lambda x: np.ones(2), [(1,)])


@pytest.mark.parametrize("path", sorted(EXERCISES.glob("*.py")), ids=lambda p: p.stem)
def test_no_case_depends_on_what_was_checked_before(path):
    # random numbers of the module are drawn once, when it is read; inside a checker they would be others every time
    assert not [
        line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith(" ") and "RNG" in line
    ]
