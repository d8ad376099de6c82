"""Make nbval fail where it would pass without having checked anything.

On its own nbval 0.11 lets four kinds of notebook cells through:

1. a cell tagged ``nbval-check-output`` without an execution count (stripped) or a stored output: nothing is compared;
2. a cell tagged ``raises-exception`` in which nothing is raised;
3. a cell aborted by an unknown magic: IPython reports that on stderr only, and the rest of the cell never runs;
4. a failed shell command: ``!false`` merely sets ``_exit_code``.

``tests/test_nbval_hardening.py`` shows each of them passing without this file and failing with it.
"""

import os
from collections.abc import Iterator

import pytest
from nbval.plugin import IPyNbCell, NbCellError

os.environ.setdefault("TQDM_DISABLE", "1")  # before tqdm is imported: tests read what commands print

# Makes a failed `!command` an exception, which nbval does notice.
STRICT_SHELL = "get_ipython().system_raise_on_error = True"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Run one notebook cell and fail it where nbval had nothing to say; leave every other test alone."""
    if not isinstance(item, IPyNbCell) or item.options["skip"]:
        return (yield)
    _require_reference(item)
    _make_shell_strict(item)
    replies = _record_replies(item)
    result = yield
    _require_exception(item)
    _require_completion(item, replies)
    return result


def _fail(item: IPyNbCell, message: str) -> None:
    raise NbCellError(item.cell_num, message, item.cell.source)


def _require_reference(item: IPyNbCell) -> None:
    """Refuse to compare with outputs that are not there (hole 1). Plain --nbval compares silent cells too."""
    if not item.options["check"]:
        return
    if item.cell.execution_count is None:
        _fail(item, "checked cell has no execution count, so nbval compares nothing: execute the notebook and save it")
    if not item.parent.compare_outputs and not item.cell.outputs:
        _fail(item, "checked cell has no stored output to compare with: print something, or drop the tag")


def _make_shell_strict(item: IPyNbCell) -> None:
    """Let failed shell commands raise (hole 4), once per kernel; other languages than Python have no such switch."""
    kernel = item.parent.kernel
    if getattr(kernel, "shell_is_strict", False) or kernel.language != "python":
        return
    reply = kernel.execute_cell_input(STRICT_SHELL, allow_stdin=False)
    kernel.await_reply(reply, timeout=item.config.option.nbval_kernel_startup_timeout)
    kernel.shell_is_strict = True


def _record_replies(item: IPyNbCell) -> list[dict]:
    """Return a list that fills with the kernel's execute replies while the cell runs; nbval throws them away."""
    kernel = item.parent.kernel
    get_message = type(kernel).get_message
    replies: list[dict] = []

    def recording(stream: str, timeout: float | None = None) -> dict:
        message = get_message(kernel, stream, timeout)
        if message["msg_type"] == "execute_reply":
            replies.append(message["content"])
        return message

    kernel.get_message = recording
    return replies


def _require_exception(item: IPyNbCell) -> None:
    """Refuse a cell that should have raised and did not (hole 2)."""
    if item.options["check_exception"] and not any(out.output_type == "error" for out in item.test_outputs):
        _fail(item, "cell is tagged raises-exception, yet nothing was raised")


def _require_completion(item: IPyNbCell, replies: list[dict]) -> None:
    """Refuse a cell that the kernel did not run to its end without ever reporting an exception (hole 3)."""
    if item.options["check_exception"]:
        return
    status = replies[-1]["status"] if replies else "no reply"
    if status != "ok":
        reason = "; ".join(out.text.strip() for out in item.test_outputs if out.output_type == "stream")
        _fail(item, f"cell was aborted (kernel status {status!r}): {reason or 'no reason given'}")
