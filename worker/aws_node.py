"""The name ``python -P -m worker.aws_node`` of :mod:`worker.node.aws_batch`, which lasts: job definitions at AWS hold it, also in images of other versions."""

import sys

from worker.node.aws_batch import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
