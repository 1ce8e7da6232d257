"""Adam takes torch's own steps, and does not bring torch's compiler along."""

import subprocess
import sys

import torch

from sattools.fit.adam import Adam


def walk(kind: type[torch.optim.Adam]) -> list[torch.Tensor]:
    """Six steps down a bowl, with rates that change on the way."""
    place = torch.tensor([[1.0, -2.0], [0.5, 30.0]], requires_grad=True)
    other = torch.tensor([4.0], requires_grad=True)
    adam = kind([{"params": [place], "name": "place"}, {"params": [other], "lr": 0.1}], lr=0.5, betas=(0.9, 0.99))
    for k in range(6):
        adam.zero_grad(set_to_none=True)
        adam.param_groups[0]["lr"] = 0.5 / (1 + k)
        ((place**2).sum() + (other * place[0]).abs().sum()).backward()
        adam.step()
    return [place.detach(), other.detach(), *(v for p in (place, other) for v in adam.state[p].values())]


def test_steps_are_those_of_torch() -> None:
    for own, torchs in zip(walk(Adam), walk(torch.optim.Adam), strict=True):
        assert torch.equal(own, torchs)


def test_parameters_learn_outside_of_their_own_steps() -> None:
    place = torch.ones(2, requires_grad=True)
    adam = Adam([place], lr=0.25)
    place.sum().backward()
    adam.step()
    assert place.requires_grad
    assert place.tolist() == [0.75, 0.75]


def test_the_compiler_stays_away() -> None:
    code = (
        "import sys, torch; from sattools.fit.adam import Adam; p = torch.ones(3, requires_grad=True); "
        "a = Adam([p], lr=0.1); p.sum().backward(); a.step(); a.zero_grad(); print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "False\n"
