"""What holds of every attempt, whatever happens in whatever order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.domain import attempt
from orchestrator.domain import attempt_instructions as do
from orchestrator.domain.attempt_events import (
    Delayed,
    Due,
    Event,
    Gone,
    Launched,
    Observed,
    Preempted,
    Prepared,
    Silence,
    StartRefused,
)
from orchestrator.domain.job import Ending, NodeEnd, Status
from orchestrator.domain.native_options import NativeOptions

NODES = 2

moments = st.integers(0, 200_000).map(lambda each: 10_000_000 + each)
codes = st.sampled_from([0, 1, 75, 137, 143])
node_ends = st.none() | st.builds(
    NodeEnd, codes, st.just("why"), st.floats(0, 9), lost=st.booleans(), requested=st.booleans()
)
both = st.just([None] * NODES) | st.lists(node_ends, min_size=NODES, max_size=NODES)
silence = st.builds(Silence, st.floats(0, 60), st.just("12:00:00 UTC"), st.booleans(), st.sampled_from(["", "cut off"]))
silences = st.just([None] * NODES) | st.lists(st.none() | silence, min_size=NODES, max_size=NODES)
words = st.sampled_from(["", "words"])
delays = st.builds(Delayed, words, st.booleans())
prepared = st.just(Prepared(7))
prepares = st.one_of(
    *[prepared] * 3,
    *(st.none(), st.just(Delayed("silent")), st.just(StartRefused("refused"))),
)
launches = st.one_of(*[st.just(Launched("handle"))] * 4, delays, st.just(StartRefused("refused")))
polls = st.builds(Observed, moments, both, silences, words, words, words)
gone = st.builds(Gone, moments, both | st.just([]), words)
stops = st.one_of(gone, gone, gone, st.none(), st.just(Delayed("not allowed")))


@dataclass(frozen=True)
class Turn:
    """One turn of the controller: what happens before its look, and what the engine answers where it is asked."""

    before: Event | str | None
    """A text: the user asks the job to end, which a request writes to the database."""
    prepare: Event | None
    launch: Event
    seen: Observed
    stop: Event | None


out_of_place = st.one_of(launches, polls, gone)
before = st.one_of(*[st.none()] * 4, st.just("enough"), st.just(Preempted("preempted by job b")), out_of_place)
turns = st.builds(Turn, before, prepares, launches, polls, stops)
policies = st.sampled_from(["ignore", "restart", "fail"])
terms = st.builds(
    attempt.Terms,
    number=st.just(1),
    hosts=st.just(("h/0", "h/1")),
    whole=st.just(NODES),
    main=st.integers(0, NODES - 1),
    options=st.builds(NativeOptions, is_native=st.booleans(), on_child_failure=policies),
    grace=st.just(30.0),
    timeout=st.none() | st.just(60),
    allowed=st.integers(1, 3),
    conditions=st.just([]) | st.just([{"action": "EXIT", "onExitCode": "1"}]),
)


@dataclass(frozen=True)
class Page:
    """An event of a story and what followed from it."""

    before: attempt.AttemptState
    event: Event
    instructions: do.Instructions
    now: attempt.AttemptState


def story_of(terms: attempt.Terms, turns: Sequence[Turn]) -> list[Page]:
    """A job's attempts, one after the other."""
    state, pages = attempt.AttemptState(terms), list[Page]()
    for turn in turns:
        events: list[Event] = [Due()]
        if isinstance(turn.before, str):
            state = state if state.closed else replace(state, stop_reason=turn.before)
        elif turn.before is not None:
            events.insert(0, turn.before)
        while events:
            event = events.pop(0)
            before, instructions = state, attempt.step(state, event)
            for instruction in instructions:
                state = attempt.after(state, instruction)
                match instruction:
                    case do.Prepare() if turn.prepare is not None:
                        events.append(turn.prepare)
                    case do.Launch():
                        events.append(turn.launch)
                    case do.Observe():
                        events.append(turn.seen)
                    case do.Stop() if turn.stop is not None:
                        events.append(turn.stop)
                    case do.WindUp():
                        events.append(Gone(turn.seen.moment, [], ""))
            pages.append(Page(before, event, instructions, state))
            if (close := closed(pages[-1])) is not None and close.status is Status.RUNNABLE:  # the next attempt
                spent = state.terms.spent + close.spent
                following = replace(state.terms, number=state.terms.number + 1, spent=spent)
                state, events = attempt.AttemptState(following, stop_reason=state.stop_reason), []
    return pages


def closed(page: Page) -> do.Close | None:
    return next((each for each in page.instructions if isinstance(each, do.Close)), None)


stories = st.builds(story_of, terms, st.lists(turns, min_size=8, max_size=14))


@settings(max_examples=50)
@given(stories)
def test_each_epoch_is_launched_once_and_nothing_is_stopped_before_its_end_is_saved(story: list[Page]) -> None:
    kept = [page.before.terms.number for page in story for each in page.instructions if isinstance(each, do.Keep)]
    assert len(kept) == len(set(kept)), "a second handle of one epoch"
    for page in story:
        assert not any(isinstance(each, do.Launch) for each in page.instructions) or not page.before.launched
        for index, each in enumerate(page.instructions):
            if isinstance(each, do.Stop):
                assert page.before.launched and page.now.verdict is not None
                assert page.before.verdict is not None or do.Save() in page.instructions[:index], (
                    "a crash would forget it"
                )
            if isinstance(each, do.Keep | do.TakeEpoch):
                assert do.Save() in page.instructions[index:], "a crash would forget it"
            if isinstance(
                each,
                do.Prepare | do.Launch | do.Observe | do.Stop | do.WindUp,
            ):
                assert each is page.instructions[-1], "what it leads to is decided on when all else is carried out"


@settings(max_examples=50)
@given(stories)
def test_a_job_that_is_over_stays_over_and_attempts_are_spent_up_to_the_limit(story: list[Page]) -> None:
    allowed = story[0].before.terms.allowed
    closes = [close for page in story if (close := closed(page))]
    assert not any(each.status.is_terminal for each in closes[:-1])
    assert all(page.instructions == () for page in story if page.before.closed)
    assert sum(each.spent for each in closes) <= allowed
    again = [each for each in closes if each.status is Status.RUNNABLE]
    assert sum(each.spent for each in again) < allowed, "an attempt that the job does not have"
    assert all(each.reason for each in closes)


@settings(max_examples=50)
@given(stories)
def test_a_stop_that_was_asked_for_is_not_forgotten(story: list[Page]) -> None:
    for page in story:
        if page.before.stop_reason is None or page.before.closed:
            continue
        assert page.now.stop_reason == page.before.stop_reason
        if (close := closed(page)) is not None:
            assert close.status.is_terminal, "it is started again"
        if isinstance(page.event, Observed) and page.before.launched:
            assert page.now.verdict is not None, "the next look decides its end"
        if isinstance(page.event, Delayed) and page.before.phase is attempt.AttemptPhase.LAUNCHING and page.event.idle:
            assert do.WindUp() in page.instructions, "nothing is launched any more"


@settings(max_examples=50)
@given(stories, polls)
def test_an_attempt_that_is_not_closed_has_a_next_look_and_each_look_gives_a_reason_or_brings_the_end_about(
    story: list[Page], seen: Observed
) -> None:
    for page in story:
        state = page.now
        if state.closed:
            continue
        next_poll = do.Observe if state.launched else do.Launch if state.prepared else do.Prepare
        expected = next_poll if state.prepared or (state.verdict is None and state.stop_reason is None) else do.WindUp
        assert isinstance(attempt.step(state, Due())[-1], expected)
        follows = attempt.step(state, seen) if state.launched else ()
        if state.verdict is not None or any(isinstance(each, do.Decide) for each in follows):
            assert not follows or isinstance(follows[-1], do.Stop | do.Await)
        elif state.launched and (
            follows or seen.unread is None
        ):  # of ends that are being read nothing is reported at first
            assert isinstance(follows[0], do.Explain | do.MarkRunning) and follows[0].reason


@settings(max_examples=50)
@given(stories)
def test_an_end_that_was_decided_for_a_launched_gang_stays(story: list[Page]) -> None:
    for page in story:
        if page.before.launched and page.before.verdict is not None:
            assert page.now.verdict == page.before.verdict
            assert not any(isinstance(each, do.Decide) for each in page.instructions)


@settings(max_examples=50)
@given(stories)
def test_leaving_on_request_and_preemption_spend_no_attempt_and_fail_no_job(story: list[Page]) -> None:
    for page in story:
        close, verdict, since = closed(page), page.now.verdict, page.before.running_since
        if close is None or verdict is None:
            continue
        ran = close.moment - (since or close.moment)
        is_free = verdict.ending is Ending.PREEMPTED or (
            verdict.ending is Ending.REQUEUE and ran >= attempt.SHORTEST_REQUEUE
        )
        assert close.spent is not is_free
        if is_free and page.before.stop_reason is None:
            assert close.status in (Status.RUNNABLE, Status.SUCCEEDED)


@settings(max_examples=25)
@given(terms, st.lists(turns, min_size=12, max_size=20))
def test_a_gang_whose_main_node_is_done_succeeds(terms: attempt.Terms, turns: Sequence[Turn]) -> None:
    done = [NodeEnd(0, "done", 1.0)] * NODES
    answered = [
        Turn(
            None,
            Prepared(7),
            Launched("handle"),
            replace(turn.seen, ends=done, waits="", unread=None),
            Gone(turn.seen.moment, done, ""),
        )
        for turn in turns
    ]
    assert [each.status for page in story_of(terms, answered) if (each := closed(page))] == [Status.SUCCEEDED]
