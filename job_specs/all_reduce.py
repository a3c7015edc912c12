"""Each node prints its rank and takes part in one all-reduce: the sum of (rank + 1) over all ranks.

Plain torch.distributed: the address, the rank and the world size come from the environment, as under torchrun.
"""

import os

import torch
import torch.distributed as dist

dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
rank, world = dist.get_rank(), dist.get_world_size()
device = f"cuda:{os.environ['LOCAL_RANK']}" if torch.cuda.is_available() else "cpu"
value = torch.tensor([rank + 1.0], device=device)
dist.all_reduce(value)
print(
    f"rank {rank} of {world} on node {os.environ['NODE_RANK']}: sum = {value.item():.0f}, expected {world * (world + 1) // 2}"
)
assert value.item() == world * (world + 1) // 2
dist.barrier()  # who leaves first closes connections that another may still read
dist.destroy_process_group()
