"""The name ``python -P -m worker.slurm_node`` of :mod:`worker.node.slurm`, which lasts: the scripts of jobs that wait in Slurm hold it, also in images of other versions."""

import sys

from worker.node.slurm import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
