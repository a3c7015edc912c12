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
    seen: dict[str, Any] = {}
    iterations: list[int] = []
    lines: list[str] = []
    try:
        asked = ""
        for name, data, _ in visitor.events(f'/jobs/{job}/stream?last={{"i":0,"l":{{}}}}'):
            if name == "facts":
                seen |= data
            elif name == "metrics" and not data.get("again"):
                iterations += data["iterations"]
                seen["series"] = data["series"]
            elif name == "lines":
                lines += [line[5] for line in data["lines"]]
            elif name == "checkpoints" and data["order"]:
                seen["checkpoints"] = data["order"]
            if len(iterations) > 5 and not asked:
                asked = visitor.submit(f"/jobs/{job}/save").json()["message"]
            if "checkpoints" in seen and not seen.get("stopped"):
                seen["stopped"] = visitor.submit(f"/jobs/{job}/stop", confirmed="yes").status_code
        assert iterations == list(range(1, iterations[-1] + 1)), "each iteration once, in order"
        assert {"reward", "reward_alive", "value_loss", "collect_seconds"} <= seen["series"].keys()
        ranks = [seen["series"][f"rank_collect_seconds/{rank}"][-1] for rank in (0, 1)]
        assert all(seconds > 0 for seconds in ranks)
        assert asked.startswith("checkpoint ") and seen["straggler"].startswith("rank ")
        assert (seen["stopped"], seen["status"], seen["open"]) == (200, "FAILED", "")
        assert any(re.match(r"iteration +1/100000 ", line) for line in lines)
        page = visitor.page(f"/jobs/{job}")
        assert "stopped in the console by" in page.text and page.all("input", type="radio", value=str(iterations[-1]))
    finally:
        visitor.close()
