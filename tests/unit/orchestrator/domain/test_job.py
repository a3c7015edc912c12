"""States and their transitions, and what the ends of nodes mean for a job."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from orchestrator.domain.attempt import AttemptPhase
from orchestrator.domain.job import (
    AWS_ENDINGS,
    Ending,
    NodeEnd,
    RunTime,
    Status,
    aws_ending,
    check_transition,
    container_reason,
    has_exited,
    judge,
    judge_as_aws,
    retries,
)

S = Status
LEGAL = {
    S.SUBMITTED: (S.PENDING, S.RUNNABLE, S.FAILED),
    S.PENDING: (S.RUNNABLE, S.SUCCEEDED, S.FAILED),
    S.RUNNABLE: (S.STARTING, S.FAILED),
    S.STARTING: (S.RUNNING, S.RUNNABLE, S.SUCCEEDED, S.FAILED),
    S.RUNNING: (S.RUNNABLE, S.SUCCEEDED, S.FAILED),
}


def ends(*codes: tuple[float, ...] | int | None) -> list[NodeEnd | None]:
    """By node index: a code, its time and whether it was asked to end, or None for a node that runs."""
    reported = [each if isinstance(each, tuple) else (each,) for each in codes]
    return [
        None
        if each[0] is None
        else NodeEnd(int(each[0]), f"exit {each[0]}", *each[1:2] or (1.0,), requested=len(each) > 2)
        for each in reported
    ]


@pytest.mark.parametrize(("before", "after"), list(itertools.product(Status, Status)))
def test_a_job_moves_as_on_aws_and_in_no_other_way(before: Status, after: Status) -> None:
    if before == after or after in LEGAL.get(before, ()):
        check_transition(before, after)
    else:
        with pytest.raises(ValueError, match=f"^a job can't go from {before} to {after}$"):
            check_transition(before, after)


def test_databases_of_older_controllers_hold_these_words() -> None:
    assert [each.value for each in Status] == [each.name for each in Status]
    assert [each.value for each in (*Ending, *AttemptPhase)] == [each.name.lower() for each in (*Ending, *AttemptPhase)]


@pytest.mark.parametrize(
    ("attempts", "seconds", "since"),
    [
        ([(10_000, 13_000), (20_000, 24_500), (None, None)], 7.5, None),
        ([(10_000, 13_000), (90_000, None)], 13.0, 87_000),
        ([(110_000, None)], 0.0, 100_000),  # a clock that was put back
    ],
)
def test_a_job_has_run_as_long_as_its_attempts_together(
    attempts: list[tuple[int | None, int | None]], seconds: float, since: int | None
) -> None:
    assert RunTime.of(attempts, 100_000) == RunTime(seconds, since)
    assert RunTime.of([(None, None)], 100_000) is None and RunTime.of([], 100_000) is None


def test_aws_s_words_for_an_end_are_found_within_other_words_and_others_are_not() -> None:
    for words in (
        "Essential container in task exited",
        "Task failed to start",
        "Host EC2 (instance local/a-1) terminated.",
    ):
        assert AWS_ENDINGS.sub("X", f"attempt 1 failed ({words}); trying again") == "attempt 1 failed (X); trying again"
        assert AWS_ENDINGS.search(f"main node: rank 0 exited with code 1: RuntimeError: {words}") is None
    assert AWS_ENDINGS.search("Job attempt duration exceeded timeout") is None


NOT_STARTED = "Task failed to start"


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ({}, (Ending.FAILED, "Essential container in task exited", 137)),
        ({"lost": True}, (Ending.FAILED, "Host EC2 (instance a) terminated.", None)),
        ({"cannot_start": True}, (Ending.FAILED, NOT_STARTED, None)),
    ],
)
def test_on_aws_only_a_container_that_ran_to_its_end_has_an_exit_code(
    facts: dict[str, bool], expected: tuple[Ending, str, int | None]
) -> None:
    end = NodeEnd(137, "its own words", 1.0, **facts)
    verdict = judge_as_aws(0, (end, None), "a")
    assert verdict and (verdict.ending, verdict.reason, verdict.exit_code) == expected
    assert aws_ending(end, "a") == verdict.reason and has_exited(verdict.reason) is (verdict.exit_code is not None)


RUNS, DONE, FAILED, LEFT = None, 0, 1, 75
GOES_ON = None
SUCCEEDED = (Ending.SUCCEEDED, "Essential container in task exited", 0)

# policy, index of the main node, how the nodes ended → ending, reason, exit code
VERDICTS = [
    # nothing has ended
    ("restart", 0, (RUNS, RUNS), GOES_ON),
    ("ignore", 0, (RUNS,), GOES_ON),
    # the main node's end ends the job and decides
    ("restart", 0, (DONE, RUNS), SUCCEEDED),
    ("ignore", 1, (RUNS, DONE), SUCCEEDED),
    ("fail", 0, (DONE, FAILED), SUCCEEDED),
    ("restart", 0, (LEFT, RUNS), (Ending.REQUEUE, "exit 75", 75)),
    ("ignore", 0, (LEFT, LEFT), (Ending.REQUEUE, "exit 75", 75)),
    ("restart", 0, (FAILED, RUNS), (Ending.FAILED, "main node: exit 1", 1)),
    ("fail", 0, (FAILED, RUNS), (Ending.FAILED, "main node: exit 1", 1)),
    ("ignore", 0, (FAILED, RUNS), (Ending.FAILED, "main node: exit 1", 1)),
    ("restart", 1, (RUNS, (137, 2.0)), (Ending.FAILED, "main node: exit 137", 137)),
    # children that end well end nothing
    ("restart", 0, (RUNS, DONE), GOES_ON),
    ("fail", 0, (RUNS, LEFT), GOES_ON),
    # a child's failure is what the policy says
    ("restart", 0, (RUNS, FAILED), (Ending.FAILED, "node 1: exit 1", 1)),
    ("fail", 0, (RUNS, FAILED), (Ending.FATAL, "node 1: exit 1", 1)),
    ("ignore", 0, (RUNS, FAILED), GOES_ON),
    ("ignore", 0, (RUNS, FAILED, 137), GOES_ON),
    ("restart", 2, (FAILED, RUNS, RUNS), (Ending.FAILED, "node 0: exit 1", 1)),
    # of several failures the first by time is the cause, whoever's it is
    ("restart", 0, ((1, 5.0), (137, 4.0)), (Ending.FAILED, "node 1: exit 137", 137)),
    ("restart", 0, ((1, 4.0), (137, 5.0)), (Ending.FAILED, "main node: exit 1", 1)),
    ("fail", 0, ((1, 5.0), (137, 4.0)), (Ending.FATAL, "node 1: exit 137", 137)),
    ("fail", 0, ((1, 4.0), (137, 5.0)), (Ending.FAILED, "main node: exit 1", 1)),
    ("ignore", 0, ((1, 5.0), (137, 4.0)), (Ending.FAILED, "main node: exit 1", 1)),
    ("restart", 0, (RUNS, (2, 9.0), (3, 8.0), (0, 1.0)), (Ending.FAILED, "node 2: exit 3", 3)),
    ("restart", 0, (RUNS, (2, 8.0), (3, 8.0)), (Ending.FAILED, "node 1: exit 2", 2)),
]


@pytest.mark.parametrize(("policy", "main", "codes", "expected"), VERDICTS)
def test_the_ends_of_nodes_are_judged(
    policy: str, main: int, codes: tuple[tuple[float, ...] | int | None, ...], expected: tuple[Ending, str, int] | None
) -> None:
    verdict = judge(policy, main, ends(*codes))
    assert (verdict and (verdict.ending, verdict.reason, verdict.exit_code)) == expected


REQUESTED = [
    # what was asked to end is the cause only where nothing else is, in any order of reading, and whatever the clocks say
    ((RUNS, (143, 1.0, True)), "node 1: exit 143", False),
    ((RUNS, (143, 1.0, True), (137, 2.0)), "node 2: exit 137", True),
    ((RUNS, (137, 2.0), (143, 1.0, True)), "node 1: exit 137", True),
    (((143, 1.0, True), (137, 2.0), (143, 0.5, True)), "node 1: exit 137", True),
    (((1, 3.0), (143, 1.0, True), (137, 2.0)), "node 2: exit 137", True),
    (((143, 1.0, True), RUNS, RUNS), "main node: exit 143", False),
    (((143, 2.0, True), (143, 1.0, True), RUNS), "node 1: exit 143", False),
    (((143, 2.0, True), (143, 1.0, True)), "node 1: exit 143", True),
    (((143, 2.0, True), DONE), "main node: exit 143", True),
]


@pytest.mark.parametrize(("codes", "reason", "certain"), REQUESTED)
def test_a_node_that_was_asked_to_end_is_not_the_cause(
    codes: tuple[tuple[float, ...] | int | None, ...], reason: str, certain: bool
) -> None:
    verdict = judge("restart", 0, ends(*codes))
    assert verdict and (verdict.reason, verdict.certain) == (reason, certain)


def test_on_aws_only_the_main_node_matters_and_a_gang_never_goes_on_without_it() -> None:
    for main_code, *child_codes in itertools.product((None, 0, 1, 75), repeat=3):
        alone = judge("ignore", 0, ends(main_code))
        assert judge("ignore", 0, ends(main_code, *child_codes)) == alone
    for policy, main_code, child in itertools.product(("restart", "fail", "ignore"), (0, 1, 75, 137), (None, 0, 1, 75)):
        assert judge(policy, 0, ends(main_code, child)) is not None


@pytest.mark.parametrize(
    ("reason", "status_reason", "shown"),
    [
        (None, None, None),
        ("done", "Essential container in task exited", None),
        ("rank 0 exited with code 1: ValueError: x", "Essential container in task exited", None),
        ("rank 1 was killed by SIGTERM", None, None),
        ("container exited with code 2", None, None),
        ("exit 0, outcome not written (OSError: x)", None, None),
        *((f"{name}Error: x", None, f"{name}Error: x") for name in ("OutOfMemory", "CannotPullContainer")),
        ("can't start 'x': not there", NOT_STARTED, "CannotStartContainerError: can't start 'x': not there"),
        ("CannotPullContainerError: x", NOT_STARTED, "CannotPullContainerError: x"),
        ("can't start 'x': a program's own words", "Essential container in task exited", None),
        ("the supervisor died", "Host EC2 (instance a) terminated.", "Host EC2 (instance a) terminated."),
    ],
)
def test_the_reason_of_a_container_is_the_one_that_aws_gives(
    reason: str | None, status_reason: str | None, shown: str | None
) -> None:
    assert container_reason(reason, status_reason) == shown


@pytest.mark.parametrize("policy", ["restart", "ignore", "fail"])
def test_the_fault_of_the_node_that_was_the_cause_is_the_attempts(policy: str) -> None:
    here, present = "ValueError in reward.py, line 3", "ValueError in reward.py, line 4"
    main, child = NodeEnd(1, "exit 1", 1.0, fault=here), NodeEnd(1, "exit 1", 2.0, fault=present)
    verdict = judge(policy, 0, (main, child))
    assert verdict is not None and verdict.fault == here
    late = judge(policy, 0, (replace(main, ended=3.0), child))
    assert late is not None and late.fault == (here if policy == "ignore" else present)
    aws = judge_as_aws(0, (main, child), "host")
    assert aws is not None and aws.fault is None


EXIT, RETRY = {"action": "EXIT"}, {"action": "retry"}

# conditions, exit code → whether the attempt is tried again; its reason is "OutOfMemory: killed", its status reason "Host lost"
CONDITIONS = {
    "no condition": ([], 1, True),
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


@pytest.mark.parametrize("case", CONDITIONS)
def test_the_first_condition_that_matches_decides(case: str) -> None:
    conditions, code, expected = CONDITIONS[case]
    assert retries(conditions, code, "OutOfMemory: killed", "Host lost") is expected
