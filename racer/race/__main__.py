"""``python -m racer.race``: the rank of a job that has a checkpoint drive laps: an evaluation whose episodes are a race's trials."""

from __future__ import annotations

from worker.evaluate import main
from worker.learning.job import run_command

if __name__ == "__main__":
    run_command(lambda: main("race"))
