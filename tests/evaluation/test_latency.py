import time

import pytest
import torch

from ditr_lite.evaluation.latency import KINDS, REST, where_time_goes


def test_every_operation_is_counted_where_it_belongs():
    conv, x = torch.nn.Conv2d(8, 8, 3, padding=1), torch.randn(2, 8, 64, 64)

    def call():
        time.sleep(0.02)
        return conv(x)

    begin = time.perf_counter()
    spent = where_time_goes(call, runs=2)
    whole = 1000 * (time.perf_counter() - begin)
    assert set(spent) == {*KINDS, REST} and list(spent.values()) == sorted(spent.values(), reverse=True)
    assert spent["convolution"] > 0 and spent["attention"] == 0
    assert 20 <= spent[REST] < whole and sum(spent.values()) < whole


@pytest.mark.parametrize(
    ("call", "kind"),
    [
        (lambda x: torch.matmul(x, x), "matrix product"),
        (lambda x: x.amin(1), "minimum"),
        (lambda x: x.min(1), "minimum"),
        (torch.nn.functional.silu, "activation"),
        (lambda x: torch.nn.functional.group_norm(x[None], 8), "normalisation"),
        (lambda x: torch.cat([x, x]), "moving and resizing"),
        (lambda x: x.cumsum(0), REST),
    ],
)
def test_kinds(call, kind):
    x = torch.randn(512, 512)
    spent = where_time_goes(lambda: [call(x) for _ in range(20)], runs=1)
    named = {k: ms for k, ms in spent.items() if k != REST and ms > 0}  # calling costs time, too
    assert max(named, key=named.get, default=REST) == kind
