"""What an exercise checker is made of: run beside the reference, name the mistake, print the verdict, never raise."""

import copy
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

Function = Callable[..., Any]


def check(
    name: str,
    attempt: Function,
    reference: Function,
    inputs: Sequence[tuple],
    mistakes: Mapping[str, Function] | None = None,
    rtol: float = 1e-5,
    dtype: bool = False,
) -> bool:
    """Compare ``attempt`` with ``reference`` on every input; print the verdict and return whether they agree.

    Args:
        name: what the exercise asks for; printed.
        attempt: the learner's function.
        reference: the right one.
        inputs: one tuple of arguments per case.
        mistakes: message -> wrong function; the first one that yields the learner's results is named.
        rtol: relative tolerance; 0 asks for the same bits.
        dtype: whether the kind of number must be the reference's, float32 for float32.
    """
    return announce(name, lambda: _compare(attempt, reference, inputs, mistakes or {}, rtol, dtype))


def announce(name: str, problem: Callable[[], str | None]) -> bool:
    """Print the outcome of ``problem()``, a reason or None when all is well, and return whether it is well.

    Exceptions become reasons; ``NotImplementedError`` is an exercise that was not attempted.
    """
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            reason = problem()
    except NotImplementedError:
        reason = "not attempted yet"
    except (Exception, SystemExit) as error:  # whatever the learner's code does, the notebook goes on
        reason = f"stopped with {type(error).__name__}: {error}"
    print(f"✗ {name}: {reason}" if reason else f"✓ {name}")
    return not reason


def _compare(attempt, reference, inputs, mistakes, rtol, dtype) -> str | None:
    """Return why ``attempt`` is wrong, or None."""
    results = []
    for case in inputs:
        given = copy.deepcopy(case)
        results.append(attempt(*given))
        if any(isinstance(a, np.ndarray) and not np.array_equal(a, b) for a, b in zip(given, case, strict=True)):
            return "it changes its input; work on a copy"
    wanted = [reference(*copy.deepcopy(case)) for case in inputs]
    reasons = [_difference(got, want, rtol, dtype or rtol == 0) for got, want in zip(results, wanted, strict=True)]
    reason = next(filter(None, reasons), None)
    if reason is None:
        return None
    for message, wrong in mistakes.items():
        try:
            made = [wrong(*copy.deepcopy(case)) for case in inputs]
            same = not any(_difference(got, m, rtol or 1e-6) for got, m in zip(results, made, strict=True))
        except Exception:  # a mistake that cannot be made on these inputs
            continue
        if same:
            return message
    return reason


def _difference(got: Any, want: Any, rtol: float, dtype: bool = False) -> str | None:
    """Return how ``got`` differs from ``want``, or None."""
    if got is None:
        return "it returns nothing: is a `return` missing?"
    if _ragged(got) or _ragged(want):
        return _difference_of_parts(got, want, rtol)
    got = [_array(part) for part in got] if isinstance(got, list | tuple) else _array(got)
    got, want = np.asarray(got), np.asarray(want)
    if got.shape != want.shape:
        return f"the result should have shape {want.shape}, got {got.shape}"
    if (want.dtype == bool) != (got.dtype == bool):
        return f"the result should be {want.dtype}, got {got.dtype}"
    if got.dtype.kind not in "bfiu":
        return f"the result should be numbers, got {got.dtype}"
    if dtype and got.dtype != want.dtype:
        return f"the result should be {want.dtype}, got {got.dtype}"
    same = got == want if rtol == 0 or want.dtype == bool else np.isclose(got, want, rtol=rtol, atol=0, equal_nan=True)
    if same.all():
        return None
    if same.ndim == 0:
        return f"expected {want:.6g}, got {got:.6g}"
    where = tuple(int(k) for k in np.argwhere(~same)[0])
    n = int((~same).sum())
    return f"{n} of {same.size} values differ; at {where} expected {want[where].item()}, got {got[where].item()}"


def _ragged(result: Any) -> bool:
    """Return whether a result is a list of parts that fit into no single array."""
    if not isinstance(result, list | tuple):
        return False
    return len({np.shape(part) for part in result if not _ragged(part)}) > 1 or any(map(_ragged, result))


def _shape(part: Any) -> str:
    return "several" if _ragged(part) else str(np.shape(part))


def _array(got: Any) -> Any:
    """Return a tensor without its gradient, with which it is no array; all else as it is."""
    return got.detach() if hasattr(got, "detach") else got


def _difference_of_parts(got: Any, want: Any, rtol: float) -> str | None:
    """Return how results of which one has parts of different shapes differ, or None."""
    shapes = [[_shape(part) for part in result] if isinstance(result, list | tuple) else None for result in (got, want)]
    if None in shapes or shapes[0] != shapes[1]:
        found, wished = ("one array" if s is None else " and ".join(s) for s in shapes)
        return f"its parts should have the shapes {wished}, got {found}"
    differences = (_difference(a, b, rtol) for a, b in zip(got, want, strict=True))
    return next(filter(None, differences), None)
