"""How the paper trains its denoiser, as far as it says: batches of 64 at a rate of 1e-6 (Paper: Sec. V-B).

Our own recipes (``recipes``) depart from it: AdamW, one cosine decay, minutes, not days. The rate needs a reading:
1e-6 is also latent diffusion's *base* rate, which its training script multiplies by batch size and number of GPUs. The
paper, which follows latent diffusion, does not say whether it did.
"""

import torch
from torch import nn

BATCH, BASE_RATE = 64, 1e-6


def scaled_rate(base: float = BASE_RATE, batch: int = BATCH, gpus: int = 1) -> float:
    """Return the rate that latent diffusion's script trains with when told ``base``: times batch size and GPUs.

    Raises:
        ValueError: for a rate that is not positive, or a batch or number of GPUs below 1.
    """
    if not base > 0 or batch < 1 or gpus < 1:
        raise ValueError(f"expected a positive base, batch and gpus of at least 1, got {base}, {batch}, {gpus}")
    return base * batch * gpus


def make_optimiser(model: nn.Module, lr: float = BASE_RATE) -> torch.optim.Adam:
    """Return Adam, latent diffusion's optimiser (the paper names none for stage two), over what is not frozen.

    Raises:
        ValueError: when all parameters are frozen.
    """
    parameters = [p for p in model.parameters() if p.requires_grad]
    if not parameters:
        raise ValueError("expected a model with parameters to train, all of them are frozen; call requires_grad_()")
    return torch.optim.Adam(parameters, lr)
