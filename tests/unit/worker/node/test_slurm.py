"""What a task of a Slurm job makes of its surroundings."""

from __future__ import annotations

from shared_store.contract import NodeContract, job_variables
from worker.node.slurm import environment_of


def test_a_node_gets_slurms_variables_but_not_the_token_that_its_controller_called_sbatch_with() -> None:
    contract = NodeContract("job", 1, 0, 1, 0, "127.0.0.1", 29500, "run", "/store", 1, 1)
    told = {"kind": [0], "kinds": [{"environment": {"LEVEL": "3"}}]}
    found = environment_of(told, contract, {"SLURM_JWT": "secret", "SLURM_NNODES": "2", "PATH": "/bin"})
    assert "secret" not in found.values()
    assert (found["SLURM_NNODES"], found["MUSTER_RUN"]) == ("2", "run")
    assert job_variables(found) == {"LEVEL": "3"}
