"""SimTrace files of a training: whole episodes of some cars, the same ones after a kill, and nothing of the training changes by them."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from racer.car.sim_trace import SIM_TRACE_COLUMNS
from racer.car.task import Racer
from racer.car.training_trace import CARS as MOST_CARS
from racer.control.evaluate_options import _copy
from racer.race.trials import Laps
from racer.settings.task import RacerConfig
from racer.store.races import race_changes, rules_of
from racer.tracks.presets import make_preset
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import read_metrics
from tests.support.worker.loop import alone
from tests.support.worker.ranks import training
from tests.support.worker.runs import assert_same_bits, last, runner, train
from worker.evaluation.episodes import play
from worker.learning.loop import Loop
from worker.learning.trained import load_policies
from worker.settings.overrides import configured

CARS, STEPS = 4, 24
SPACE = {"steering_angle": {"low": -30.0, "high": 30.0}, "speed": {"low": 0.5, "high": 2.0}}
SMALL = {"worlds": CARS, "iterations": 6, "every": 2, "ppo": {"steps": STEPS, "minibatches": 2, "hidden_sizes": [8]}}
CHOICES = [{"steering_angle": angle, "speed": 1.0} for angle in (-30, 0, 30)]


def racing(store: Path, run: str, epoch: int = 1, **changes: Any) -> dict[str, str]:
    config = {"track": "oval", "episode_seconds": 3.0, **changes}
    return training(store, run=run, epoch=epoch, task="Racer", config=config, **SMALL)


def files(store: Path, run: str) -> dict[int, list[dict[str, str]]]:
    """The rows of each file, by its number."""
    folder = Store(store).run(run).path / "sim-trace" / "training" / run / "training-simtrace"
    found = {}
    for path in folder.iterdir():
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            found[int(path.name.removesuffix("-iteration.csv"))] = list(reader)
            assert tuple(reader.fieldnames or ()) == SIM_TRACE_COLUMNS
    return found


def episodes(rows: list[dict[str, str]]) -> list[list[dict[str, str]]]:
    """Of each episode in a file, in their order."""
    numbers = dict.fromkeys(row["episode"] for row in rows)
    return [[row for row in rows if row["episode"] == number] for number in numbers]


def without_clock(store: Path, run: str) -> dict[int, list[dict[str, str]]]:
    return {number: [{**row, "wall_clock": ""} for row in rows] for number, rows in files(store, run).items()}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """With a training of which each car is traced."""
    path = tmp_path_factory.mktemp("store")
    train(racing(path, "traced", sim_trace=16), task=Racer).close()
    yield path


def test_a_file_has_the_whole_episodes_that_ended_in_its_iteration(store: Path) -> None:
    message = {record["iteration"] - 1: record for record in records(Store(store).run("traced"))}
    found = files(store, "traced")
    assert found.keys() == {number for number, record in message.items() if record["episodes"]} and 0 in found
    for number, rows in found.items():
        ended = episodes(rows)
        assert len(ended) == message[number]["episodes"]
        numbers = [int(episode[0]["episode"]) for episode in ended]
        # from file 0 deepracer-utils learns how many an iteration can have
        assert numbers == [*range(len(ended) - 1), MOST_CARS * STEPS - 1 if number == 0 else len(ended) - 1]
        for episode in ended:
            assert [row["steps"] for row in episode] == [str(step) for step in range(len(episode))]
            assert [row["episode_status"] == "prepare" for row in episode] == [True] + [False] * (len(episode) - 1)
            assert [row["done"] for row in episode] == ["False"] * (len(episode) - 1) + ["True"]
        returns = [sum(float(row["reward"]) for row in episode) for episode in ended]
        assert sum(returns) / len(ended) == pytest.approx(message[number]["reward"], abs=0.01)
        lengths = [len(episode) - 1 for episode in ended]
        assert sum(lengths) / len(ended) == pytest.approx(message[number]["episode_length"])


def test_the_training_is_the_same_bit_for_bit_without_a_trace(store: Path) -> None:
    train(racing(store, "plain"), task=Racer).close()
    assert_same_bits(last(store, "traced"), last(store, "plain"))
    assert not (Store(store).run("plain").path / "sim-trace").exists()


def test_after_a_kill_and_a_resume_the_files_are_those_of_a_training_that_was_not_interrupted(store: Path) -> None:
    killed = runner(racing(store, "killed", sim_trace=16), task=Racer)
    stop_after(killed, 5)  # the newest checkpoint is that of iteration 4
    assert list_checkpoints(Store(store).run("killed"))[-1].iteration == 4
    assert 4 in files(store, "killed")
    train(racing(store, "killed", epoch=2, sim_trace=16), task=Racer).close()
    assert without_clock(store, "killed") == without_clock(store, "traced")


def test_a_trace_that_begins_at_a_resume_has_no_episode_without_its_beginning(store: Path) -> None:
    stop_after(runner(racing(store, "late"), task=Racer), 5)
    train(racing(store, "late", epoch=2, sim_trace=2), task=Racer).close()
    rows = [row for rows in files(store, "late").values() for row in rows]
    assert rows and all(episode[0]["episode_status"] == "prepare" for episode in episodes(rows))


@pytest.mark.parametrize("damage", [b"", b"x" * 100, None], ids=["empty", "other", "cut"])
def test_episodes_in_a_damaged_file_are_left_out_with_a_warning(
    store: Path, damage: bytes | None, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f"damaged-{len(damage) if damage is not None else 'cut'}"
    stop_after(runner(racing(store, name, sim_trace=2), task=Racer), 5)
    path = Store(store).run(name).path / "sim-trace" / "unfinished" / "00000004.npz"
    path.write_bytes(path.read_bytes()[:300] if damage is None else damage)
    train(racing(store, name, epoch=2, sim_trace=2), task=Racer).close()
    (warning,) = [line for line in capsys.readouterr().out.splitlines() if "unfinished" in line]
    assert warning.startswith(f"warning: {path} can't be read (")
    assert warning.endswith("); its unfinished episodes are left out of the trace")
    assert all(
        episode[0]["episode_status"] == "prepare" for rows in files(store, name).values() for episode in episodes(rows)
    )


def test_more_cars_from_a_resume_on_have_numbers_of_their_own(store: Path) -> None:
    stop_after(runner(racing(store, "more", sim_trace=1), task=Racer), 5)
    train(racing(store, "more", epoch=2, sim_trace=4), task=Racer).close()
    found = files(store, "more")
    # as deepracer-utils counts: the greatest number of file 0 says how many an iteration can have
    most = 1 + max(int(row["episode"]) for row in found[0])
    unique = [number * most + int(each[0]["episode"]) for number, rows in found.items() for each in episodes(rows)]
    assert most >= 4 * STEPS and len(unique) == len(set(unique))


def test_deepracer_utils_reads_a_training(store: Path, tmp_path: Path) -> None:
    pytest.importorskip("deepracer", reason="pip install deepracer-utils, or make tracking")
    from deepracer.logs import AnalysisUtils, DeepRacerLog

    config = {"action_space": {"action_space": CHOICES}, "sim_trace": 3}
    train(racing(tmp_path, "choosing", **config), task=Racer).close()
    for run in (Store(store).run("traced"), Store(tmp_path).run("choosing")):
        log = DeepRacerLog(str(run.path))
        log.load_training_trace()
        rows = log.dataframe()
        present = files(run.path.parents[1], run.name)
        assert len(rows) == sum(map(len, present.values()))
        assert set(rows["iteration"]) == present.keys()
        ended = sum(len(episodes(each)) for each in present.values())
        aggregated = AnalysisUtils.simulation_agg(rows, secondgroup="unique_episode")
        assert len(aggregated) == ended
        assert rows["unique_episode"].max() < SMALL["iterations"] * MOST_CARS * STEPS
        assert log.hyperparameters() == json.loads((run.path / "ip" / "hyperparameters.json").read_text())
        assert log.hyperparameters()["batch_size"] == CARS * STEPS // 2
        assert log.agent_and_network()["network"] == "MLP"
        chosen = set(rows[rows["episode_status"] != "prepare"]["action"])
        assert chosen == {-1} if run.name == "traced" else chosen <= {0, 1, 2}  # it knows no continuous actions
    assert log.action_space() == CHOICES


def test_deepracer_utils_reads_a_race_with_the_training_beside_it_from_what_the_command_copies(
    store: Path, tmp_path: Path
) -> None:
    pytest.importorskip("deepracer", reason="pip install deepracer-utils, or make tracking")
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from deepracer.logs import AnalysisUtils, DeepRacerLog, PlottingUtils
    from deepracer.tracks import Track

    run, oval = Store(store).run("traced"), make_preset("oval")
    checkpoint = list_checkpoints(run)[-1]
    task = Racer(configured(RacerConfig, {"track": "oval", **race_changes({"seconds": 4.0})}), 3, seed=5)
    laps = Laps(task)
    (policy,) = load_policies(checkpoint, "cpu", 1)
    played = play([task], policy, alone(), watch=laps.note)
    laps.race(played, rules_of({}), 5, checkpoint.manifest).write(run.evaluations / "00000006-e1-job")
    _copy(run.path, "00000006-e1-job", tmp_path / "race", quiet=True)
    log = DeepRacerLog(str(tmp_path / "race"))
    log.load_evaluation_trace()
    driven = AnalysisUtils.simulation_agg(log.df, firstgroup="stream", secondgroup="episode", is_eval=True)
    assert driven["steps"].tolist() == [int(length) + 1 for length in played.lengths]
    assert driven["time"].tolist() == pytest.approx([float(length) / 15 for length in played.lengths], abs=0.002)
    assert (log.action_space(), log.hyperparameters()["num_epochs"]) == (SPACE, 5)
    track = Track("oval", np.concatenate([oval.center, oval.inner, oval.outer], 1))
    PlottingUtils.plot_evaluations(log.df, track)
    log.load_training_trace(force=True)
    trained = files(store, "traced")
    assert log.df["iteration"].nunique() == len(trained)
    PlottingUtils.plot_track(log.df, track)
    AnalysisUtils.analyze_training_progress(
        AnalysisUtils.simulation_agg(log.df, secondgroup="unique_episode"), groupby_field="unique_episode"
    )
    rows = trained[0][1:3]
    for row in rows:  # what deepracer-utils leaves out, as AWS writes it
        steering, speed = map(float, row["action"].strip("[]").split())
        assert (steering, speed) == pytest.approx((float(row["steer"]), float(row["throttle"])), abs=0.006)


def records(run: Run) -> list[dict[str, Any]]:
    return list(read_metrics(run))


def stop_after(loop: Loop, iterations: int) -> None:
    """End an attempt after so many iterations as a kill does, except that what it has sent to be written is written."""
    for _ in range(iterations):
        loop._handle(loop._iterate()[1])
    loop.state.finish()
    loop.reporter.close()
    loop.fence.close()
    loop.close()
