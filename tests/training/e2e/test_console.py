"""The page of a job while it really trains: what comes over its stream, and what a person does to it there."""

from __future__ import annotations

import re
from typing import Any

from tests.conftest import Serving
from tests.support.console.visitor import Visitor
from tests.support.worker.cartpole import submit


def test_a_training_is_followed_saved_and_stopped_from_its_page(server: Serving) -> None:
    # the training saves only when the page asks for it
    job = submit(server, "train.iterations=100000", "checkpoint.every=100000", "resources.cpus=0.3")["id"]
    visitor = Visitor(server.url)
    parts: dict[str, Any] = {}
    series: dict[str, Any] = {}
    iterations: list[int] = []
    lines: list[str] = []
    saved = ""
    stopped = 0
    try:
        for name, data, _ in visitor.events(f'/jobs/{job}/stream?last={{"i":0,"l":{{}}}}'):
            if name == "parts":
                parts |= data
            elif name == "metrics" and not data.get("again"):
                iterations += data["iterations"]
                series = data["series"]
            elif name == "lines":
                lines += [line[5] for line in data["lines"]]
            if len(iterations) > 5 and not saved:
                saved = visitor.submit(f"/jobs/{job}/save").json()["message"]
            if parts.get("checkpoints", {}).get("rows") and not stopped:
                stopped = visitor.submit(f"/jobs/{job}/stop", confirmed="yes").status_code
        assert iterations == list(range(1, iterations[-1] + 1)), "each iteration once, in order"
        assert {"reward", "reward_alive", "value_loss", "collect_seconds"} <= series.keys()
        assert all(series[f"rank_collect_seconds/{rank}"][-1] > 0 for rank in (0, 1))
        assert saved.startswith("checkpoint ") and stopped == 200
        assert re.search(r"Slowest</dt><dd>rank [01], ", parts["facts"]) and "FAILED" in parts["headline"]
        assert any(re.match(r"iteration +1/100000 ", line) for line in lines)
        page = visitor.page(f"/jobs/{job}")
        assert "stopped in the console by" in page.text and page.all("input", type="radio", value=str(iterations[-1]))
    finally:
        visitor.close()
