"""What is printed must not stop the control loop."""

from __future__ import annotations

import threading

from muster_policy import lines as module
from muster_policy.lines import Lines


def test_a_stopped_terminal_does_not_block_and_later_lines_are_dropped() -> None:
    goes_on, said = threading.Event(), list[str]()

    def tell(line: str) -> None:
        goes_on.wait()
        said.append(line)

    lines = Lines(tell)
    for number in range(2 * module.MOST):
        lines.say(str(number))
    assert said == []
    goes_on.set()
    while len(said) < module.MOST:
        pass
    lines.say("the end")
    lines.close()
    assert said[:3] == ["0", "1", "2"] and said[-1] == "the end" and len(said) <= module.MOST + 2
