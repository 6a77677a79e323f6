"""Networks with their optimiser, and their state as plain arrays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import nn


def adam(network: nn.Module, rate: float, decay: float = 0.0) -> torch.optim.Optimizer:
    """Adam on all parameters of `network`, with a pull of `decay` times themselves towards zero."""
    return torch.optim.Adam(network.parameters(), lr=rate, weight_decay=decay, fused=True)


def descend(optimiser: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    """One gradient step."""
    optimiser.zero_grad(set_to_none=True)
    torch.autograd.backward(loss)
    optimiser.step()


@contextmanager
def frozen(network: nn.Module) -> Iterator[None]:
    """Gradients go through `network` but not into it."""
    network.requires_grad_(False)
    try:
        yield
    finally:
        network.requires_grad_(True)


def follow(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Moves the target's parameters by the part `tau` of the way to the source's."""
    with torch.no_grad():
        ours, theirs = list(target.parameters()), list(source.parameters())
        torch._foreach_lerp_(ours, theirs, tau)


def state_of(network: nn.Module, optimiser: torch.optim.Optimizer | None = None) -> dict[str, Any]:
    """Weights and the optimiser's moments as a tree of arrays."""
    weights = {key: value.numpy().copy() for key, value in network.state_dict().items()}
    if optimiser is None:
        return {"weights": weights}
    moments = {
        str(index): {key: np.asarray(value.numpy()).copy() for key, value in entry.items()}
        for index, entry in optimiser.state_dict()["state"].items()
    }
    return {"weights": weights, "moments": moments}


def restore(
    tree: dict[str, Any], network: nn.Module, optimiser: torch.optim.Optimizer | None = None
) -> None:
    """Takes over what `state_of` gave."""
    network.load_state_dict({key: torch.from_numpy(v) for key, v in tree["weights"].items()})
    if optimiser is not None:
        state = optimiser.state_dict()
        state["state"] = {
            int(index): {key: torch.from_numpy(np.array(v)) for key, v in entry.items()}
            for index, entry in tree["moments"].items()
        }
        optimiser.load_state_dict(state)
