"""A rank starts without torch's compiler, and has it as soon as somebody wants it."""

from __future__ import annotations

import subprocess
import sys

from tests.support.worker.ranks import ROOT

SCRIPT = """
import sys
from worker.distributed import Placement, connect
connect(Placement(), device="cpu")
import torch, tensordict
import worker.learning.loop
weight = torch.ones(3, requires_grad=True)
adam = torch.optim.Adam([weight], lr=torch.tensor(0.1), fused=True)
weight.sum().backward()
adam.step()
adam.load_state_dict(adam.state_dict())
assert "torch._dynamo.symbolic_convert" not in sys.modules, "an eager rank needs no compiler"
torch.compile(lambda x: x * 2 + weight[0], backend="eager")(torch.ones(3))
import torch._dynamo.config
assert "torch._dynamo.symbolic_convert" in sys.modules
print("both")
"""


def test_the_compiler_is_left_out_until_it_is_wanted() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("both\n")
