"""Whether an attempt that failed is tried again: ``evaluateOnExit``."""

from __future__ import annotations

import pytest

from orchestrator.domain.job import retries

EXIT, RETRY = {"action": "EXIT"}, {"action": "retry"}

# conditions, exit code → whether the attempt is tried again; its reason is "OutOfMemory: killed", its status reason "Host lost"
CASES = {
    "nothing said": ([], 1, True),
    "nothing matches": ([{**EXIT, "onExitCode": "2"}], 1, True),
    "the code matches": ([{**EXIT, "onExitCode": "1"}], 1, False),
    "a part of the code does not": ([{**EXIT, "onExitCode": "1"}], 12, True),
    "a pattern ends in a star": ([{**EXIT, "onExitCode": "1*"}], 12, False),
    "and begins with the text": ([{**EXIT, "onExitCode": "1*"}], 21, True),
    "a star alone matches all": ([{**EXIT, "onReason": "*"}], 1, False),
    "a star in front is a star": ([{**EXIT, "onReason": "*killed"}], 1, True),
    "the reason matches": ([{**EXIT, "onReason": "OutOfMemory*"}], 1, False),
    "the status reason matches": ([{**EXIT, "onStatusReason": "Host*"}], 1, False),
    "another status reason does not": ([{**EXIT, "onStatusReason": "Network*"}], 1, True),
    "all that is named has to match": ([{**EXIT, "onExitCode": "1", "onReason": "no*"}], 1, True),
    "an empty pattern is not named": ([{**EXIT, "onExitCode": "1", "onReason": ""}], 1, False),
    "without a container there is no code": ([{**EXIT, "onExitCode": "*"}], None, False),
    "and none equals it": ([{**EXIT, "onExitCode": "None"}], None, True),
    "nor begins it": ([{**EXIT, "onExitCode": " *"}], None, True),
    "the first that matches decides": ([{**RETRY, "onExitCode": "1"}, {**EXIT, "onExitCode": "*"}], 1, True),
    "whatever follows": ([{**EXIT, "onExitCode": "*"}, {**RETRY, "onExitCode": "1"}], 1, False),
}


@pytest.mark.parametrize("case", CASES)
def test_the_first_condition_that_matches_decides(case: str) -> None:
    conditions, code, expected = CASES[case]
    assert retries(conditions, code, "OutOfMemory: killed", "Host lost") is expected
