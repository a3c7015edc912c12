"""What a rank and the command start without: torch's compiler, which is available as soon as something needs it, and Rerun."""

from __future__ import annotations

import subprocess
import sys

from tests.conftest import PATIENCE
from tests.support.worker.ranks import ROOT

SCRIPT = """
import sys
from worker.learning.distributed import RankPlacement, connect
connect(RankPlacement(), device="cpu")
import torch, tensordict
import worker.learning.loop
weight = torch.ones(3, requires_grad=True)
adam = torch.optim.Adam([weight], lr=torch.tensor(0.1), fused=True)
weight.sum().backward()
adam.step()
adam.load_state_dict(adam.state_dict())
assert "torch._dynamo.symbolic_convert" not in sys.modules, "an eager rank needs no compiler"
import orchestrator.cli, orchestrator.cli.recordings, worker.telemetry.tap, worker.tasks.library.cartpole, newton
assert "rerun" not in sys.modules, "neither the command nor a training needs it"
torch.compile(lambda x: x * 2 + weight[0], backend="eager")(torch.ones(3))
import torch._dynamo.config
assert "torch._dynamo.symbolic_convert" in sys.modules
print("all")
"""


def test_compiler_and_rerun_are_left_out_until_they_are_wanted() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True, timeout=60 * PATIENCE
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("all\n")
