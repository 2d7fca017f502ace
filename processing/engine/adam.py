"""Adam for small networks, on whichever device their parameters are."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """Parameters, their learning rate and what Adam keeps of them (Kingma and Ba 2015; betas .9 and .99).

    torch.optim.Adam would do the same steps, but importing torch._dynamo for it costs each process two CPU seconds.
    """

    def __init__(self, parameters: Sequence[Tensor], learning_rate: float, weight_decay: float = 0.0) -> None:
        self._parameters, self._rate, self._decay = list(parameters), learning_rate, weight_decay
        self._mean, self._square = ([torch.zeros_like(p) for p in self._parameters] for _ in range(2))
        self._steps = [torch.zeros((), device=p.device) for p in self._parameters]

    @torch.no_grad()
    def step(self, decay: float = 1.0) -> None:
        """One step along the gradients, which are used up; the learning rate decays by this factor."""
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in self._parameters]
        adam(self._parameters, gradients, self._mean, self._square, [], self._steps, fused=True, amsgrad=False,
             beta1=0.9, beta2=0.99, lr=self._rate, weight_decay=self._decay, eps=1e-8, maximize=False)  # fmt: skip
        self._rate *= decay
        for parameter in self._parameters:
            parameter.grad = None
