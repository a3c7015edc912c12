"""Every path of ``worker`` on which ranks wait for one another, taken by two real ranks on Gloo (:mod:`tests.support.worker.gangs`)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.layout import Run, Store
from tests.support.worker.clones import make_clone
from tests.support.worker.collectives import ALONE, TESTS, paths
from tests.support.worker.gangs import Played, case, digest, play_cases, started, supplied
from tests.support.worker.loop import alone, iterate
from tests.support.worker.motion_task import Turning, motion
from tests.support.worker.point_task import Point, PointConfig, PointPPO, Tripping
from tests.support.worker.ranks import training
from tests.support.worker.runs import runner, train
from tests.support.worker.sac import make
from worker.evaluation.episodes import play
from worker.learning.algorithm import WorldShare
from worker.learning.distributed import Gang
from worker.learning.job import Job, StopRequest
from worker.learning.ppo.fused import PPO
from worker.learning.randomness import seed_generators

WORLDS = 7
"""Of both ranks: they have 3 and 4."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("gang")


@pytest.fixture(scope="module")
def played(store: Path) -> Played:
    """What each rank returned from each case, by its name."""
    return play_cases("training.worker.test_gangs", training(store))


@pytest.fixture
def reported(played: Played, request: pytest.FixtureRequest) -> list[Any]:
    """What both ranks returned from the case of this test, or the error that both raised."""
    name = request.node.name
    first, second = played[name]
    assert ("error" in first) == ("error" in second), (first, second)
    return [each.get("error") or each["result"] for each in (first, second)]


def test_every_path_was_taken_by_two_ranks(played: Played) -> None:
    taken = {name: {(f, line) for rank in ranks for f, line in rank["seen"]} for name, ranks in played.items()}
    everywhere = set().union(*taken.values())
    missing = [
        call
        for call in paths()
        if call.function not in ALONE
        and not any((call.function, line) in everywhere for line in range(call.first, call.last + 1))
    ]
    assert not missing, "calls that no case takes"
    untrue = {f: name for f, name in TESTS.items() if f not in {function for function, _ in taken[name]}}
    assert not untrue, "the list names another test than one that takes this path"


# -- commands ---------------------------------------------------------------------------------------------------------


@case
def a_training_is_the_same_on_all_ranks_to_its_end(gang: Gang, store: Path) -> Any:
    from worker import train

    started(gang, Store(store).run("taught"))
    with supplied(gang, {**training(store, run="taught", iterations=2, every=1), "MUSTER_WORLDS": str(WORLDS)}):
        return train.main()


def test_a_training_is_the_same_on_all_ranks_to_its_end(reported: list[Any], store: Path) -> None:
    assert reported == [0, 0]
    run = Store(store).run("taught")
    assert [each.name for each in list_checkpoints(run)] == ["00000001-e1", "00000002-e1"]
    assert list_checkpoints(run)[-1].manifest["shards"] == [[0, 3], [3, 4]]
    assert list_evaluations(run)[0]["episodes"] == WORLDS


@case
def an_evaluation_has_the_episodes_of_all_ranks_in_every_round(gang: Gang, store: Path) -> Any:
    from worker import evaluate

    section = {"run": "taught", "episodes": 70, "checkpoint": 1, "config": {"randomize": {"mass": [0.5, 2.0]}}}
    spec = {"name": "evaluate", "evaluate": section}
    env = {**training(store, run="judge"), "MUSTER_SPEC": json.dumps(spec), "MUSTER_JOB_ID": f"of-{gang.size}"}
    with supplied(gang, env):
        return evaluate.main()


def test_an_evaluation_has_the_episodes_of_all_ranks_in_every_round(reported: list[Any], store: Path) -> None:
    """Two rounds of 64 worlds, each built anew; one rank alone plays the same episodes."""
    assert reported == [0, 0]
    assert an_evaluation_has_the_episodes_of_all_ranks_in_every_round(alone(), store) == 0
    one, two = ((Store(store).run("taught").evaluations / f"00000001-e1-of-{n}.parquet").read_bytes() for n in (1, 2))
    assert one == two


@case
def a_request_to_leave_that_one_rank_has_got_ends_all_with_a_checkpoint(gang: Gang, store: Path) -> Any:
    stop = StopRequest()
    stop.requested = gang.rank == 1
    started(gang, Store(store).run("stopped"))
    return runner(training(store, run="stopped"), gang, stop).train()


def test_a_request_to_leave_that_one_rank_has_got_ends_all_with_a_checkpoint(reported: list[Any], store: Path) -> None:
    assert reported == [75, 75]
    assert [each.name for each in list_checkpoints(Store(store).run("stopped"))] == ["00000001-e1"]


class Still:
    """A policy that does nothing."""

    def act(self, observations: Any) -> torch.Tensor:
        return torch.zeros(len(observations["policy"]), 1)

    def reset(self, dones: torch.Tensor | None = None) -> None:
        pass


@case
def episodes_are_played_until_the_last_one_of_any_rank_has_ended(gang: Gang, store: Path) -> Any:
    share = WorldShare.of(gang.rank, gang.size, WORLDS)
    fallen, standing = (PointConfig(episode_seconds=5.0, limit=limit) for limit in (0.0, 3.0))
    rounds = (fallen if gang.rank else standing, fallen)
    tasks = [Point(config, share.count, seed=2, first_world=share.first) for config in rounds]
    return play(tasks, Still(), gang).rows.tolist()


def test_episodes_are_played_until_the_last_one_of_any_rank_has_ended(reported: list[Any]) -> None:
    assert reported[0] == reported[1] and len(reported[0]) == 2 * WORLDS
    assert [row[1] for row in reported[0]] == [50.0] * 3 + [1.0] * 4 + [1.0] * 7, "steps of each episode"


@case
def an_evaluation_that_one_rank_is_requested_to_leave_ends_on_all(gang: Gang, store: Path) -> Any:
    play([Point(PointConfig(episode_seconds=5.0), 3)], Still(), gang, is_stop_requested=lambda: gang.rank == 1)


def test_an_evaluation_that_one_rank_is_requested_to_leave_ends_on_all(reported: list[Any]) -> None:
    assert reported == ["Stopped: "] * 2


# -- where a run begins -----------------------------------------------------------------------------------------------


@case
def a_resumed_gang_takes_the_newest_checkpoint_that_can_be_read(gang: Gang, store: Path) -> Any:
    run = started(gang, Store(store).run("resumed"))
    train(training(store, run="resumed", iterations=3, every=1), gang)
    if gang.is_main:
        (list_checkpoints(run)[-1].path / "learner.pt").write_bytes(b"")
    started(gang, run, 2)
    again = runner(training(store, run="resumed", epoch=2), gang)
    return [again.resumed and again.resumed.name, digest(again.algorithm.state_dict()), again.state.progress.iteration]


def test_a_resumed_gang_takes_the_newest_checkpoint_that_can_be_read(reported: list[Any]) -> None:
    assert reported[0] == reported[1] and reported[0][::2] == ["00000002-e1", 2]


@case
def a_chosen_checkpoint_that_is_gone_is_refused_by_all_ranks(gang: Gang, store: Path) -> Any:
    started(gang, Store(store).run("resumed"), 3)
    runner(training(store, run="resumed", epoch=3, MUSTER_CHECKPOINT="00000009-e1", MUSTER_JOB_EPOCH=3), gang)


def test_a_chosen_checkpoint_that_is_gone_is_refused_by_all_ranks(reported: list[Any]) -> None:
    assert reported[0] == reported[1] and reported[0].startswith("DamagedCheckpoint: ") and "00000009-e1" in reported[0]


@case
def a_clone_begins_with_the_same_weights_on_all_ranks(gang: Gang, store: Path) -> Any:
    if gang.is_main:
        make_clone(store, "clone", "taught")
    started(gang, Store(store).run("clone"))
    clone = runner(training(store, run="clone"), gang)
    return [clone.adopted and clone.adopted.name, digest(clone.algorithm.state_dict()["policy"])]


def test_a_clone_begins_with_the_same_weights_on_all_ranks(reported: list[Any], store: Path) -> None:
    learnt = torch.load(list_checkpoints(Store(store).run("taught"))[-1].path / "learner.pt", weights_only=True)
    assert reported == [["00000002-e1", digest(learnt["algorithm"]["policy"])]] * 2


@case
def a_clone_without_its_weights_is_refused_by_all_ranks(gang: Gang, store: Path) -> Any:
    started(gang, Store(store).run("orphan"))
    runner(training(store, run="orphan", MUSTER_PARENT="taught"), gang)


def test_a_clone_without_its_weights_is_refused_by_all_ranks(reported: list[Any]) -> None:
    assert reported[0] == reported[1] and reported[0].startswith(
        "UserError: run orphan can't begin with the weights of taught"
    )


class Pupil(PPO):
    """PPO that notes what it is taught."""

    teacher_checkpoint = "taught@1"
    learnt = ""

    def load_teacher(self, state: Any) -> None:
        self.learnt = digest(state["policy"])


def learnt_by(gang: Gang, store: Path, run: str, epoch: int = 1) -> str:
    started(gang, Store(store).run(run), epoch)
    algorithm = {"algorithm": "tests.training.worker.test_gangs:Pupil", "settings": {"steps": 8}}
    return str(runner(training(store, run=run, epoch=epoch, **algorithm), gang).algorithm.learnt)  # type: ignore[attr-defined]


@case
def all_ranks_have_the_teacher_whether_it_was_copied_or_not(gang: Gang, store: Path) -> Any:
    if gang.is_main:
        copy = Store(store).run("copied").teacher("taught").checkpoints
        shutil.copytree(list_checkpoints(Store(store).run("taught"))[0].path, copy / "00000001-e1")
    gang.greatest(0)
    return [learnt_by(gang, store, run) for run in ("copied", "not-copied")]


def test_all_ranks_have_the_teacher_whether_it_was_copied_or_not(reported: list[Any], store: Path) -> None:
    learnt = torch.load(list_checkpoints(Store(store).run("taught"))[0].path / "learner.pt", weights_only=True)
    assert reported == [[digest(learnt["algorithm"]["policy"])] * 2] * 2


@case
def a_teacher_that_is_missing_is_refused_by_all_ranks(gang: Gang, store: Path) -> Any:
    if gang.is_main:
        shutil.rmtree(list_checkpoints(Store(store).run("copied").teacher("taught"))[0].path)
    gang.greatest(0)
    learnt_by(gang, store, "copied", epoch=2)


def test_a_teacher_that_is_missing_is_refused_by_all_ranks(reported: list[Any]) -> None:
    assert reported == ["UserError: run taught has no checkpoint of iteration 1; available: none"] * 2


@case
def worlds_that_do_not_fit_are_refused_by_all_ranks(gang: Gang, store: Path) -> Any:
    from worker import train

    env = training(store, run="large", worlds=10**6)
    with supplied(gang, env), pytest.MonkeyPatch.context() as patch:
        patch.setattr("worker.learning.memory_estimate.free_bytes", lambda _: 10**6)
        train.main()


def test_worlds_that_do_not_fit_are_refused_by_all_ranks(reported: list[Any]) -> None:
    for rank, each in enumerate(reported):
        assert each.startswith(f"UserError: worlds: 1,000,000 worlds of Point on rank {rank} need more memory than")


@case
def worlds_that_turn_out_not_to_fit_are_measured_by_all_ranks(gang: Gang, store: Path) -> Any:
    from worker.learning import memory_estimate

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory_estimate, "free_bytes", lambda _: 10**6)
        with memory_estimate.within_memory(Point, PointConfig(), (PPO, PointPPO()), 4, gang):  # type: ignore[arg-type]
            raise MemoryError


def test_worlds_that_turn_out_not_to_fit_are_measured_by_all_ranks(reported: list[Any]) -> None:
    assert all(each.startswith("UserError: worlds: 4 worlds of Point on rank ") for each in reported)


# -- how a run ends ---------------------------------------------------------------------------------------------------


@case
def worlds_drawn_at_random_are_built_anew_for_the_evaluation(gang: Gang, store: Path) -> Any:
    started(gang, Store(store).run("drawn"))
    loop = train(training(store, run="drawn", iterations=1, config={"randomize": {"mass": [0.5, 2.0]}}), gang)
    return digest(loop.algorithm.state_dict())


def test_worlds_drawn_at_random_are_built_anew_for_the_evaluation(reported: list[Any], store: Path) -> None:
    assert reported[0] == reported[1]
    assert list_evaluations(Store(store).run("drawn"))[0]["episodes"] == 16


@case
def a_last_save_that_fails_on_one_rank_is_tried_again_by_all_until_a_stop(gang: Gang, store: Path) -> Any:
    started(gang, Store(store).run("unsaved"))
    stop = StopRequest()
    loop = runner(training(store, run="unsaved", iterations=1), gang, stop)
    if gang.rank == 1:
        file = store / f"file-{gang.rank}"
        file.touch()
        loop.state.saver.run = Run(file)
        order = loop.state.save

        def save(*supplied: Any, **named: Any) -> None:
            stop.requested = loop.state.ordered_at == 1  # in the second try
            order(*supplied, **named)

        loop.state.save = save  # type: ignore[method-assign]
    loop.train()


def test_a_last_save_that_fails_on_one_rank_is_tried_again_by_all_until_a_stop(
    reported: list[Any], store: Path
) -> None:
    assert reported[0] == reported[1] and reported[0].startswith(
        "TrainingError: training is done, but its last checkpoint"
    )
    assert not list_checkpoints(Store(store).run("unsaved"))


@case
def a_loss_that_is_not_finite_ends_all_ranks_after_their_saves(gang: Gang, store: Path) -> Any:
    started(gang, Store(store).run("poisoned"))
    config = {"poison_at": 9}  # in the second iteration
    runner(training(store, run="poisoned", every=1, config=config), gang).train()


def test_a_loss_that_is_not_finite_ends_all_ranks_after_their_saves(reported: list[Any], store: Path) -> None:
    assert reported[0].startswith("TrainingError: iteration 2: the loss is not finite")
    assert "; checkpoint 00000001-e1 stands." in reported[0] and "; there is no checkpoint yet." in reported[1]
    assert [each.name for each in list_checkpoints(Store(store).run("poisoned"))] == ["00000001-e1"]


@case
def too_many_resets_on_one_rank_end_all_after_it_has_written_why(gang: Gang, store: Path) -> Any:
    from worker.learning.loop import Loop
    from worker.learning.training import Training

    started(gang, Store(store).run("tripping"))
    job = Job.from_env(training(store, run="tripping", config={"nan_limit": 0.0}), "train")
    Loop(Training.of(job, Tripping), gang, StopRequest()).train()  # type: ignore[arg-type]


def test_too_many_resets_on_one_rank_end_all_after_it_has_written_why(reported: list[Any], store: Path) -> None:
    (written,) = Store(store).run("tripping").incidents.iterdir()
    assert written.name == "00000001-rank-1.pt"
    for each in reported:
        assert each.startswith("TrainingError: iteration 1: 8 resets of worlds, among them world 15: it tripped; ")
        assert each.endswith(f"worker.repeat_incident {written}")


@case
def start_frames_follow_the_failures_of_all_ranks(gang: Gang, store: Path) -> Any:
    started(gang, Store(store).run("turning"))
    Turning.motion = motion(store / f"turning-{gang.rank}.npz")
    name = f"{Turning.__module__}:{Turning.__qualname__}"
    loop = runner(training(store, run="turning", worlds=8, iterations=3, task=name), gang, task=Turning)
    assert loop.train() == 0
    own = loop.task.own_counts()["motion"].tolist()
    loop._begin_iteration(loop.state.progress.iteration)
    return {"own": own, "others": loop.incident._others["motion"].tolist()}


def test_start_frames_follow_the_failures_of_all_ranks(reported: list[Any]) -> None:
    first, second = reported
    assert first["others"] == second["own"] and second["others"] == first["own"]
    assert first["own"] != second["own"] and min(sum(first["own"]), sum(second["own"])) > 0


# -- algorithms -------------------------------------------------------------------------------------------------------


def dealt(gang: Gang) -> tuple[Point, WorldShare]:
    share = WorldShare.of(gang.rank, gang.size, WORLDS)
    return Point(PointConfig(), share.count, seed=2, first_world=share.first), share


@case
def sac_has_the_same_learner_and_metrics_on_all_ranks_and_each_its_own_worlds(gang: Gang, store: Path) -> Any:
    task, share = dealt(gang)
    algorithm = make(task, gang=gang, share=share, batch_size=9, policy_delay=2)
    torch.manual_seed(gang.rank)
    metrics = iterate(algorithm, task, 0, 3)
    learnt = [digest(algorithm.state_dict()), {name: float(value) for name, value in metrics.items()}]
    return {"learnt": learnt, "replay": digest(algorithm.world_state())}


def test_sac_has_the_same_learner_and_metrics_on_all_ranks_and_each_its_own_worlds(reported: list[Any]) -> None:
    assert reported[0]["learnt"] == reported[1]["learnt"] and reported[0]["learnt"][1]["critic_loss"] > 0
    assert reported[0]["replay"] != reported[1]["replay"]


ITERATIONS = 3


@case
def rsl_rl_has_the_same_weights_normalizers_and_metrics_on_all_ranks(gang: Gang, store: Path) -> Any:
    from tests.support.worker import rsl_loop

    found = {}
    for name, section in rsl_loop.SECTIONS.items():
        share = WorldShare.of(gang.rank, gang.size, WORLDS)
        task = rsl_loop.GroupedPoint(PointConfig(), share.count, seed=3, first_world=share.first)
        seed_generators(1, gang.rank)  # other weights on each rank, were they not shared
        algorithm = rsl_loop.build(task, {"num_steps_per_env": 8, **section}, gang, share)
        if "teacher_checkpoint" in section:
            algorithm.load_teacher({"policy": algorithm.algorithm.teacher.state_dict()})
        records = rsl_loop.train(algorithm, task, ITERATIONS)
        for record in records:
            del record["reward"]  # of this rank's worlds
        curious = getattr(algorithm.algorithm, "rnd", None)
        normalizer = curious.state_normalizer if curious else algorithm.algorithm.get_policy().obs_normalizer
        found[name] = {
            "learnt": digest(algorithm.state_dict()),
            "records": records,
            "count": int(normalizer.count),
            "drawn": float(torch.rand(())),
        }
    return found


def test_rsl_rl_has_the_same_weights_normalizers_and_metrics_on_all_ranks(reported: list[Any]) -> None:
    for name in reported[0]:
        one, other = (each[name] for each in reported)
        assert one["records"] == other["records"], name
        assert one["learnt"] == other["learnt"], name
        assert one["drawn"] != other["drawn"], "each draws its own actions"
        assert one["count"] == ITERATIONS * 8 * WORLDS, "of the worlds of both"
