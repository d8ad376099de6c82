"""Real datasets by name: folders on disk -> :class:`Sample`, one reader per dataset, nothing downloaded.

Paper: Sec. V-A (ClearGrasp, TODD, STD), Sec. V-F (TROSD); TransCG, DREDS and a folder of one's own are added. How the
paper trains and tests on each stands in the reader's ``protocol``.
"""

from .base import FrameFolder, teachable
from .cleargrasp import ClearGrasp, ClearGraspSynthetic
from .dreds import DREDS, STD
from .folder import Folder
from .todd import TODD
from .transcg import TransCG
from .trosd import TROSD

__all__ = [
    "DREDS",
    "REGISTRY",
    "STD",
    "TODD",
    "TROSD",
    "ClearGrasp",
    "ClearGraspSynthetic",
    "Folder",
    "FrameFolder",
    "TransCG",
    "teachable",
]

REGISTRY: dict[str, type[FrameFolder]] = {
    "cleargrasp": ClearGrasp,
    "cleargrasp_synthetic": ClearGraspSynthetic,
    "todd": TODD,
    "std": STD,
    "dreds": DREDS,
    "trosd": TROSD,
    "transcg": TransCG,
    "folder": Folder,
}
