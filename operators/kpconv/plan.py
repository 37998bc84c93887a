"""How long and how fast a network is trained: everything that, with the sessions, fixes its weights."""

from __future__ import annotations

import math
from typing import Literal

import msgspec

WARM_UP = 20  # steps of rising rate; they do not depend on the number of steps, so that they can be timed to choose it
STATISTICS = 0.02  # momentum of the batch norms' running statistics
EPOCH = 500  # steps; the authors' rate falls by 0.1^(1 / 150) an epoch


class Plan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The settings of a training run."""

    steps: int
    batch: int = 8  # spheres or windows a step, over all processes
    seed: int = 0
    optimizer: Literal["sgd", "adamw"] = "adamw"
    rate: float = 3e-3  # largest learning rate; the authors': 1e-2, by sgd
    momentum: float = 0.98  # of sgd
    decay: float = 1e-3  # of weights
    balance: float = 0.5  # points weigh as their class's share of the batch to the power of minus this; the authors': 0
    schedule: Literal["cosine", "authors"] = "cosine"
    check: int = 250  # steps between two looks at the held-out session
    patience: int = 6  # looks without a better mean recall after which training stops
    processes: int = 1

    def rate_at(self, step: int) -> float:
        """Return the learning rate of a step, from 0."""
        if step < WARM_UP:
            return self.rate * (step + 1) / WARM_UP
        if self.schedule == "authors":
            return self.rate * 0.1 ** (step / EPOCH / 150.0)
        share = (step - WARM_UP) / max(1, self.steps - WARM_UP)
        return 0.5 * self.rate * (1.0 + math.cos(math.pi * min(share, 1.0)))

    def statistics_at(self, step: int) -> float:
        """Return the batch norms' momentum: at first larger, so that statistics forget the untrained network."""
        return max(STATISTICS, 4.0 / (step + 4.0))
