"""The name ``python -P -m worker.supervisor`` of :mod:`worker.node.supervisor`, which lasts: every engine starts a node by it, also in images of other versions."""

import sys

from worker.node.supervisor import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
