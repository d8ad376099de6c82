"""The tests that every file of exercise checkers has, made from its right answers and its planted mistakes.

A test file gives them names, so that pytest finds them::

    (
        test_the_right_answer_passes,
        test_a_planted_mistake_is_named,
        test_a_stub_is_not_a_failure_of_the_notebook,
        test_every_checker_is_tested,
    ) = checker_tests(checks, RIGHT, MISTAKES)
"""

import pytest


def todo(*_):
    """Be what the student copy holds before the exercise is solved."""
    raise NotImplementedError


def checker_tests(module, right, mistakes):
    """Return four tests: right answers pass, mistakes are named, stubs are forgiven, no checker is left out.

    Args:
        module: where the checkers live, functions called ``check_*``.
        right: checker -> right answer, written as a learner would.
        mistakes: (checker, wrong answer, part of the message that must name it).
    """
    per_checker = pytest.mark.parametrize("checker", right, ids=lambda c: c.__name__)
    ids = [f"{checker.__name__}-{message}" for checker, _, message in mistakes]

    @per_checker
    def right_passes(checker, capsys):
        passed, out = checker(right[checker]), capsys.readouterr().out
        assert passed and out.startswith("✓"), out

    @pytest.mark.parametrize(("checker", "attempt", "message"), mistakes, ids=ids)
    def mistake_is_named(checker, attempt, message, capsys):
        passed, out = checker(attempt), capsys.readouterr().out
        assert not passed and out.startswith("✗") and message in out, f"expected {message!r} in: {out}"

    @per_checker
    def stub_is_forgiven(checker, capsys):
        passed, out = checker(todo), capsys.readouterr().out
        assert not passed and out.endswith("not attempted yet\n"), out
        assert not checker(lambda *_: None), "a function that returns nothing passed"
        assert not checker("nonsense"), "what is no function passed"

    def all_are_tested():
        names = {name for name in dir(module) if name.startswith("check_")}
        answered, broken = {c.__name__ for c in right}, {c.__name__ for c, _, _ in mistakes}
        assert names == answered == broken, f"not tested: {sorted(names - (answered & broken))}"

    return right_passes, mistake_is_named, stub_is_forgiven, all_are_tested
