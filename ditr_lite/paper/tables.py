"""The paper's tables as data, number for number, so that they can be audited. Nothing here is a result of ours.

Lengths are metres, shares per cent, REL a ratio. ``audit`` asks whether such numbers can be; ``ledger`` collects the
answers. Paper: Tables I to VI and Sec. V-A.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from ..metrics import METRICS

PARTS = ("geometric", "optical")  # of Table V


@dataclass(frozen=True)
class Table:
    """One table as printed.

    Attributes:
        name: T1 to T6.
        title: what is scored, and where.
        columns: column names; "geometric.rmse" is the RMSE of one part of the image.
        rows: method -> one number per column.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Mapping[str, tuple[float, ...]]

    def records(self) -> dict[str, dict[str, float]]:
        """Return {method: {column: number}}."""
        return {row: dict(zip(self.columns, values, strict=True)) for row, values in self.rows.items()}

    def reordered(self, order: tuple[str, ...]) -> "Table":
        """Return the same numbers under the metrics of every part in another order, e.g. ("rmse", "rel", "mae").

        Raises:
            ValueError: unless ``order`` holds the metrics that the parts have, each once.
        """
        had = tuple(c.split(".")[1] for c in self.columns if c.startswith(f"{PARTS[0]}."))
        if sorted(order) != sorted(had) or not had:
            raise ValueError(f"order should hold {', '.join(had) or 'nothing (no parts here)'}, each once, got {order}")
        return Table(self.name, self.title, _parts(order), self.rows)


def _parts(order: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{part}.{metric}" for part in PARTS for metric in order)


def _read(name: str, title: str, columns: tuple[str, ...], text: str) -> Table:
    rows = {}
    for line in text.strip().splitlines():
        *words, numbers = line.split(" | ")
        rows[words[0].strip()] = tuple(float(x) for x in numbers.split())
    return Table(name, title, columns, rows)


T1 = _read(
    "T1",
    "real-world ClearGrasp, overall",
    METRICS,
    """
    DeepCompletion | 0.209 0.207 0.396 34.61 52.79 71.32
    DenseDepth     | 0.057 0.059 0.083 41.82 64.48 90.35
    SRD            | 0.049 0.044 0.072 67.11 79.64 91.33
    MiDaS          | 0.044 0.038 0.069 72.87 88.12 94.37
    LDM            | 0.046 0.044 0.071 74.18 83.57 92.19
    ClearGrasp     | 0.040 0.031 0.056 68.72 85.11 96.29
    LIDF           | 0.028 0.022 0.035 79.17 91.14 98.30
    TranspareNet   | 0.026 0.022 0.039 76.93 90.02 98.10
    DFNet          | 0.025 0.021 0.037 81.99 92.83 98.10
    DITR           | 0.019 0.012 0.030 85.11 94.20 98.92
    """,
)
T2 = _read(
    "T2",
    "TODD, overall",
    METRICS,
    """
    ClearGrasp   | 0.056 0.045 0.144 33.73 53.76 85.10
    DenseDepth   | 0.052 0.039 0.110 40.94 52.17 87.42
    LDM          | 0.044 0.042 0.120 47.92 68.60 85.32
    DepthGrasp   | 0.033 0.040 0.112 42.72 70.42 89.62
    SwinDRNet    | 0.031 0.036 0.101 44.64 73.39 92.67
    LIDF         | 0.028 0.024 0.089 50.82 79.47 92.72
    DFNet        | 0.023 0.020 0.069 63.72 81.98 96.17
    TranspareNet | 0.021 0.018 0.051 60.91 85.72 98.86
    DITR         | 0.017 0.016 0.044 68.32 87.10 97.63
    """,
)
T3 = _read(
    "T3",
    "STD, overall",
    METRICS,
    """
    ClearGrasp   | 0.040 0.035 0.044 54.37 76.02 92.17
    DenseDepth   | 0.031 0.027 0.039 58.82 77.86 93.55
    DepthGrasp   | 0.020 0.018 0.027 65.44 83.12 96.69
    TranspareNet | 0.016 0.014 0.023 76.83 88.07 97.33
    LIDF         | 0.014 0.011 0.017 79.52 90.73 98.62
    DFNet        | 0.014 0.010 0.016 85.66 92.37 98.85
    SwinDRNet    | 0.011 0.008 0.012 95.07 98.39 99.75
    DITR         | 0.009 0.007 0.014 95.28 98.36 99.25
    """,
)
T4 = _read(
    "T4",
    "ablation on real-world ClearGrasp: backbone, depth partition, region refinement",
    METRICS,
    """
    BB           | 0.030 0.024 0.044 79.40 90.66 97.66
    BB + DP      | 0.020 0.014 0.032 83.62 92.59 98.17
    BB + DP + RR | 0.019 0.012 0.030 85.11 94.20 98.92
    """,
)
T5 = _read(
    "T5",
    "error breakdown on real-world ClearGrasp",
    _parts(METRICS[:3]),
    """
    DeepCompletion | 0.068 0.143 0.079 0.258 0.476 0.266
    DenseDepth     | 0.039 0.050 0.038 0.068 0.099 0.071
    SRD            | 0.028 0.039 0.027 0.059 0.074 0.055
    MiDaS          | 0.017 0.027 0.016 0.057 0.069 0.051
    ClearGrasp     | 0.022 0.033 0.019 0.052 0.061 0.044
    LIDF           | 0.017 0.024 0.016 0.039 0.042 0.029
    TranspareNet   | 0.017 0.022 0.014 0.037 0.044 0.027
    DFNet          | 0.015 0.021 0.014 0.030 0.040 0.022
    DITR           | 0.013 0.018 0.014 0.022 0.033 0.015
    """,
)
T6 = _read(
    "T6",
    "inference on 1280 x 720 images: latency in ms, operations in GFLOPs",
    ("latency", "gflops"),
    """
    ClearGrasp     | 1072 249
    MiDaS          | 393 327
    DFNet          | 387 11
    SwinDRNet      | 264 6024
    DITR stage one | 43 16
    DITR stage two | 2256 206
    """,
)
TABLES = {table.name: table for table in (T1, T2, T3, T4, T5, T6)}

# Sec. V-A: RGB-D image sets per dataset. Beside it what the datasets' own papers say.
SIZES = {"ClearGrasp": 286, "TODD": 57715, "STD": 27000}
SIZES_ELSEWHERE = {"TransCG": 57715, "TODD": 15000}  # TODD: "nearly 15,000"
