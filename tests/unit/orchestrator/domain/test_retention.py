"""What may go of old jobs and runs: nothing that is needed, whatever the rules and their order."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.domain.retention import (
    A_DAY,
    BATCH_DAYS,
    Decision,
    JobFacts,
    References,
    RetentionReference,
    RetentionRules,
    RunFacts,
    age_of,
    decide,
    rule_of,
    still_needed,
)

NOW = 1_000 * A_DAY
OLD = JobFacts("old", is_due=True)
RUN = RunFacts("r", logged=frozenset({"old"}))
NOTHING = References()


def test_an_old_run_that_holds_nothing_but_logs_goes_with_its_job() -> None:
    assert decide(RUN, [OLD], NOTHING) == Decision(True, ("old",))
    assert decide(None, [OLD], NOTHING) == Decision(False, ("old",)), "a job that never started"
    waited = References.of([RetentionReference("job", "old", "job w waits for it")])
    assert decide(None, [OLD], waited) == Decision(False, (), ("job w waits for it",))


@pytest.mark.parametrize(
    ("facts", "jobs", "references", "reason"),
    [
        ({"archived": "by key a"}, [], NOTHING, "archived"),
        ({"writer": "job 1 of another controller"}, [], NOTHING, "another controller writes it"),
        ({"damage": "run.json: not JSON"}, [], NOTHING, "can't be read"),
        ({}, [JobFacts("new", is_open=True)], NOTHING, "job new has not ended"),
        ({}, [], References.of([RetentionReference("run", "r", "model a@1 is of it")]), "model a@1 is of it"),
        ({}, [], References.of([RetentionReference("job", "old", "job w waits for it")]), "job w waits for it"),
        ({"results": ("checkpoints",)}, [], References.of([], ["model b@2 can't be read"]), "model b@2 can't be read"),
        ({}, [], References.of([], [], ["plug-in x is not installed"]), "plug-in x is not installed"),
        ({"results": ("checkpoints",)}, [], References.of([], [], ["plug-in x is not"]), "plug-in x is not"),
    ],
)
def test_nothing_of_a_run_goes_while_something_needs_it(
    facts: dict[str, Any], jobs: list[JobFacts], references: References, reason: str
) -> None:
    run = RunFacts(**{"name": "r", "logged": RUN.logged, **facts})
    decision = decide(run, [OLD, *jobs], references)
    assert (decision.run, decision.jobs) == (False, ())
    assert reason in " ".join(decision.reasons)
    assert list(decision.reasons) == still_needed(run, [OLD, *jobs], references)


def test_a_plug_in_that_can_t_be_asked_keeps_every_run_and_every_job_for_one_reason() -> None:
    unknown = References.of([], [], ["plug-in x is not installed"])
    assert still_needed(RUN, [OLD, JobFacts("young")], unknown) == ["plug-in x is not installed"]
    assert decide(None, [OLD, JobFacts("other", is_due=True)], unknown) == Decision(
        False, (), ("plug-in x is not installed",)
    )
    assert (unknown | NOTHING).unknown == (NOTHING | unknown).unknown == unknown.unknown


@pytest.mark.parametrize(
    ("facts", "jobs", "reason"),
    [
        ({"results": ("checkpoints", "a.csv", "b.csv", "c.csv")}, [], "it holds checkpoints, a.csv, b.csv, …"),
        ({"logged": frozenset({"old", "strange"})}, [], "logs of job strange"),
        ({}, [JobFacts("young")], "job young of it is kept longer"),
    ],
)
def test_old_jobs_go_without_their_run_where_that_holds_more(
    facts: dict[str, Any], jobs: list[JobFacts], reason: str
) -> None:
    decision = decide(RunFacts(**{"name": "r", "logged": RUN.logged, **facts}), [OLD, *jobs], NOTHING)
    assert (decision.run, decision.jobs) == (False, ("old",))
    assert reason in " ".join(decision.reasons)


def test_who_may_not_see_everything_does_not_learn_what_needs_a_run() -> None:
    references = References.of(
        [RetentionReference("run", "r", "run secret is a clone of it")], ["model hidden can't be read"]
    )
    unknown = References.of([], [], ["league hidden can't be read"])
    for run, needed in (
        (RUN, references),
        (RunFacts("r2", results=("checkpoints",)), references),
        (RUN, unknown),
    ):
        [reason] = still_needed(run, [OLD], needed.unnamed())
        assert "something" in reason and "secret" not in reason and "hidden" not in reason


def test_of_a_run_of_which_no_job_is_due_nothing_is_reported() -> None:
    assert decide(RUN, [JobFacts("old")], NOTHING) == Decision(False, ())
    assert decide(RUN, [], NOTHING) == Decision(False, ()), "a run of another controller, or of a lost database"


def test_after_an_upgrade_nothing_goes_in_the_first_days_and_without_a_rule_nothing_that_ended_before_the_time_began() -> (
    None
):
    upgraded = NOW - 5 * A_DAY
    rules = RetentionRules(since=upgraded)
    assert rules.batch_limit(NOW) is None
    assert rules.is_trial(NOW) and not rules.is_trial(upgraded + 7 * A_DAY) and not RetentionRules().is_trial(NOW)
    assert rules.batch_limit(upgraded + BATCH_DAYS * A_DAY) == upgraded
    assert RetentionRules(batch=False).batch_limit(NOW) is None


@pytest.mark.parametrize(
    ("rule", "age"), [("90d", 90 * A_DAY), ("36h", 36 * 3_600_000), ("1.5d", 36 * 3_600_000), ("off", None)]
)
def test_a_rule_is_a_time_or_off(rule: str, age: int | None) -> None:
    assert rule_of(rule) == age


@pytest.mark.parametrize("rule", ["", "90", "d", "-1d", "90 days", "1e9d", "Off", "99999999d"])
def test_anything_else_is_refused(rule: str) -> None:
    for parse in (age_of, rule_of):
        with pytest.raises(ValueError, match="expected days, hours or minutes, such as 90d"):
            parse(rule)


def test_a_person_may_ask_for_everything_and_a_rule_may_not() -> None:
    assert age_of("0d") == 0
    with pytest.raises(ValueError, match=r"'0d': every job would be deleted as it ends"):
        rule_of("0d")


class World:
    """Runs, jobs and what needs them, as drawn; what is taken vanishes from it."""

    def __init__(self, draw: random.Random) -> None:
        self.draw = draw
        self.runs = {f"r{number}" for number in range(draw.randint(1, 6))}
        self.jobs = {
            f"j{number}": (draw.choice(sorted(self.runs)), draw.choice(["open", "ended"]))
            for number in range(draw.randint(0, 12))
        }
        self.results = {run for run in self.runs if draw.random() < 0.4}
        self.archived = {run for run in self.runs if draw.random() < 0.2}
        self.needed_runs = {run for run in self.runs if draw.random() < 0.3}
        self.needed_jobs = {job for job in self.jobs if draw.random() < 0.2}
        self.strange = {run for run in self.runs if draw.random() < 0.1}

    def jobs_of(self, run: str) -> list[JobFacts]:
        """Any rule may let any of them go."""
        return [
            JobFacts(job, state == "open", self.draw.random() < 0.5)
            for job, (of, state) in self.jobs.items()
            if of == run
        ]

    def references(self) -> References:
        return References.of(
            [
                *(RetentionReference("run", run, "x") for run in self.needed_runs),
                *(RetentionReference("job", job, "x") for job in self.needed_jobs),
            ]
        )

    def must_stay(self) -> tuple[set[str], set[str]]:
        """Runs and jobs that no rule may take, by another road than the product's."""
        open_runs = {of for of, state in self.jobs.values() if state == "open"}
        cited = {self.jobs[job][0] for job in self.needed_jobs & self.jobs.keys()}
        whole = (self.archived | self.needed_runs | open_runs | cited) & self.runs
        jobs = {job for job, (of, state) in self.jobs.items() if of in whole or state == "open"}
        return whole | (self.runs & (self.results | self.strange)), jobs | (self.needed_jobs & self.jobs.keys())


@settings(max_examples=300, deadline=None)
@given(st.randoms(use_true_random=False))
def test_whatever_rules_let_go_nothing_that_is_needed_is_taken(draw: random.Random) -> None:
    world = World(draw)
    runs, jobs = world.must_stay()
    for _ in range(6):
        for run in draw.sample(sorted(world.runs), len(world.runs)):
            of_run = world.jobs_of(run)
            logged = {each.id for each in of_run} | ({"strange"} if run in world.strange else set())
            facts = RunFacts(
                run,
                results=("checkpoints",) if run in world.results else (),
                logged=frozenset(logged),
                archived="by key a" if run in world.archived else None,
            )
            decision = decide(facts, of_run, world.references())
            left = {each.id for each in of_run} - set(decision.jobs)
            assert not (decision.run and left), "a run never goes without all of its jobs"
            assert set(decision.jobs) <= {each.id for each in of_run if each.is_due}
            for job in decision.jobs:
                del world.jobs[job]
            if decision.run:
                world.runs.remove(run)
        assert runs <= world.runs and jobs <= world.jobs.keys()
