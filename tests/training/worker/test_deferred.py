"""What a rank and the command start without: modules that are there as soon as something needs them."""

from __future__ import annotations

import subprocess
import sys

from tests.conftest import PATIENCE
from tests.support.worker.ranks import ROOT

SCRIPT = """
import sys
from worker.settings.deferred_imports import DEFERRED, _Deferred, _StandIn, defer_imports
defer_imports()
from worker.learning.distributed import RankPlacement, connect
connect(RankPlacement(), device="cpu")
import torch, tensordict, warp
import worker.learning.loop
from worker.learning import algorithms
from worker.tasks import find_task
weight = torch.ones(3, requires_grad=True)
adam = torch.optim.Adam([weight], lr=torch.tensor(0.1), fused=True)
weight.sum().backward()
adam.step()
adam.load_state_dict(adam.state_dict())
assert torch.rand(2, generator=torch.Generator().manual_seed(1)).tolist() == torch.rand(2, generator=torch.Generator().manual_seed(1)).tolist()
algorithms.find_algorithm("ppo")
kind = find_task("Cartpole")
task = kind(kind.config_type(), 2, seed=0, device="cpu")
task.step(torch.zeros(2, 1))
import orchestrator.cli, orchestrator.cli.recordings, worker.telemetry.tap
for name in DEFERRED:
    assert isinstance(sys.modules.get(name), _Deferred | None), f"a rank needs no {name}"
assert "rerun" not in sys.modules, "neither the command nor a training needs it"
for module in warp._src.context.user_modules.values():
    for function in (each.adj.func for each in (*module.functions.values(), *module.kernels.values())):
        used = {name: function.__globals__.get(name) for name in function.__code__.co_names}
        assert not [name for name, value in used.items() if isinstance(value, _StandIn)], (module.name, used)

torch.compile(lambda x: x * 2 + weight[0], backend="eager")(torch.ones(3))
import torch._dynamo.config
assert "torch._dynamo.symbolic_convert" in sys.modules
import newton
from newton.viewer import ViewerNull
class Own(ViewerNull):
    pass
assert issubclass(Own, newton.viewer.ViewerBase._real())
assert isinstance(Own(), newton.viewer.ViewerBase) and not isinstance(3, newton.CollisionPipeline)
from pxr import Plug, Usd
assert [each for each in Plug.Registry().GetAllPlugins() if "newton" in each.name.lower()], "schemas of USD files"
print("all")
"""


def test_what_a_rank_does_not_use_is_imported_at_its_first_use() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True, timeout=60 * PATIENCE
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("all\n")
