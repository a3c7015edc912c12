"""What a learner's reward function remembers belongs to its car: in a real training each car's rewards are those of CPython alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from racer.car.task import Racer
from racer.rewards import guard, workers
from racer.rewards.parameters import TRACK
from racer.rewards.problems import RewardFailed
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import REPOSITORY
from tests.support.worker.ranks import training
from tests.support.worker.runs import runner
from worker.settings.errors import UserError

WORLDS = 4
USE = "def reward_function(params):\n    now = params['x'] + 0.01 * params['steps']\n"
FUNCTIONS = {
    "a global variable": f"last = 0.0\n{USE}    global last\n    gained, last = now - last, now\n    return gained\n",
    "an object": f"class Memory:\n    def __init__(self):\n        self.sum = 0.0\nmemory = Memory()\n{USE}"
    "    memory.sum = 0.9 * memory.sum + now\n    return memory.sum\n",
    "a class": f"class Memory:\n    last = 1.0\n{USE}    gained = now - Memory.last\n    Memory.last = now\n    return gained\n",
    "a function": f"{USE}    reward_function.calls += 1\n    return now * reward_function.calls % 7\nreward_function.calls = 0\n",
    "a default argument": f"def seen(x, kept=[]):\n    kept.append(x)\n    return sum(kept[-3:])\n{USE}    return seen(now)\n",
    "a closure": "def maker():\n    last = 0.0\n    def of(x):\n        nonlocal last\n        gained, last = x - last, x\n"
    f"        return gained\n    return of\nof = maker()\n{USE}    return of(now)\n",
    "a generator": f"def counting():\n    n = 0\n    while True:\n        n += 1\n        yield n\nsteps = counting()\n{USE}"
    "    return now + next(steps)\n",
    "a module": f"import math\nmath.last = 0.0\n{USE}    gained, math.last = now - math.last, now\n    return gained + math.pi\n",
    "a submodule": f"import numpy as np\nimport numpy.linalg\nnp.linalg.last = 0.0\n{USE}"
    "    gained, numpy.linalg.last = now - np.linalg.last, now\n    return float(np.linalg.norm([gained, 1.0]))\n",
    "random": f"import random\nfrom random import gauss\nrandom.seed(7)\n{USE}    if params['steps'] == 3:\n"
    "        random.seed(int(1000 * abs(now)))\n    return now + random.random() + gauss(0, 1) + random.choice([1, 2, 3])\n",
    "numpy.random": f"import numpy as np\nfrom numpy.random import rand\nnp.random.seed(3)\n{USE}    if params['steps'] == 2:\n"
    "        np.random.seed(int(1000 * abs(now)))\n    return float(now + rand() + np.random.normal() + np.random.sample())\n",
    "draws of scipy's rotations": "import numpy as np\nfrom scipy.spatial.transform import Rotation\nnp.random.seed(6)\n"
    f"{USE}    return float(now + np.random.rand() + Rotation.random().as_quat()[0])\n",
    "scipy's draws": f"import numpy as np\nfrom scipy import stats\nnp.random.seed(5)\n{USE}"
    "    return float(now + stats.norm.rvs() + np.random.normal() + stats.uniform.rvs(random_state=None))\n",
    "an array": f"import numpy as np\nring = np.zeros(5)\n{USE}    ring[:-1] = ring[1:]\n    ring[-1] = now\n    return float(ring.mean())\n",
    "what is rare is an error": "import numpy as np\nnp.seterr(divide='ignore')\n" + USE + "    if now > 1.0:\n"
    "        np.seterr(divide='raise')\n    try:\n        return float(np.float64(1.0) / 0.0 > now)\n    except FloatingPointError:\n"
    "        return -1.0\n",
}
ALONE = """import json, os, sys
from racer.rewards.parameters import parameters_of
asked = json.load(sys.stdin)
for car in asked["cars"]:
    if os.fork() == 0:  # a process for each car, as on AWS
        scope = {"__name__": "reward_function"}
        exec(compile(asked["source"], "reward.py", "exec"), scope)
        lines = [[tuple(point) for point in line] for line in asked["lines"]]
        rewards = [float(scope["reward_function"](parameters_of(row, rows, lines[line]))) for row, rows, line in car]
        print(json.dumps(rewards), flush=True)
        os._exit(0)
    os.wait()
"""


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Arguments and rewards of all cars in each step of a training."""
    kept, rewards = list[tuple[np.ndarray, np.ndarray, np.ndarray]](), workers.Workers.rewards

    def recorded(self: workers.Workers) -> np.ndarray:
        found = rewards(self)
        kept.append((self.numbers.copy(), self.objects.copy(), found.copy()))
        return found

    monkeypatch.setattr(workers.Workers, "rewards", recorded)
    monkeypatch.setattr(guard, "SECONDS", 60.0)  # scipy's import takes seconds on a loaded machine
    return kept


def trained(source: str, path: Path, iterations: int = 2, **config: Any) -> Racer:
    settings = {
        "reward_function": {"file": "reward.py", "text": source},
        "start": "random",
        "episode_seconds": 0.7,
        **config,
    }
    ppo = {"steps": 16}
    env = training(path, task="Racer", worlds=WORLDS, iterations=iterations, config=settings, ppo=ppo)
    loop = runner(env, task=Racer)
    assert loop.train() == 0
    loop.close()
    assert isinstance(loop.task, Racer)
    return loop.task


@pytest.mark.parametrize("kind", FUNCTIONS)
def test_the_state_of_a_function_is_its_cars_alone(kind: str, tmp_path: Path, calls: list[Any]) -> None:
    task = trained(FUNCTIONS[kind], tmp_path, alternate_direction=True)
    assert task.waits_for_host, "it was compiled: it has no state"
    race = task.sensors["race"].arrays
    lines = [line[:count].tolist() for line, count in zip(race.waypoints.numpy(), race.counts.numpy(), strict=True)]
    cars = [[(n[car].tolist(), list[Any](), int(n[car, TRACK])) for n, _, _ in calls] for car in range(WORLDS)]
    assert len(calls) >= 32 and len({line for car in cars for _, _, line in car}) == 2
    request = json.dumps({"source": FUNCTIONS[kind], "cars": cars, "lines": lines})
    answer = subprocess.run(
        [sys.executable, "-c", ALONE], input=request, capture_output=True, text=True, cwd=REPOSITORY
    )
    assert answer.returncode == 0, answer.stderr
    expected = np.array([json.loads(line) for line in answer.stdout.splitlines()], np.float32)
    found = np.stack([rewards for _, _, rewards in calls], axis=1)
    np.testing.assert_array_equal(found, expected)
    assert len({tuple(row) for row in found.tolist()}) > 1, "the cars are alike: the test shows nothing"


OWN = """class Memory:
    def __init__(self):
        self.steps = 0
memory = Memory()
def reward_function(params):
    own = params["steps"] <= 1 or params["steps"] == memory.steps + 1
    memory.steps = params["steps"]
    return 1.0 if own else 0.0
"""


def test_a_function_that_pays_each_step_of_its_own_car_pays_an_episodes_length_and_begins_anew_with_a_resumed_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained(OWN, tmp_path)
    first = capsys.readouterr().out
    copies = "reward.py: line 6: an object of the class Memory: such functions run in Python workers; each car has its own copy"
    assert copies in first and "begins anew" not in first
    trained(OWN, tmp_path, iterations=4)
    anew = "reward.py: what the function remembered of each car begins anew, since no checkpoint has it"
    assert capsys.readouterr().out.splitlines().count(anew) == 1
    records = [each for each in read_metrics(Store(tmp_path).run("run")) if each["episodes"]]
    assert len(records) >= 3
    for record in records[:2]:
        assert record["reward"] == record["episode_length"], record


LATE = "def reward_function(params):\n    n = 0\n    while params['steps'] == 7:\n        n += 1\n    return 1.0\n"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (LATE, r"reward\.py:3: car 0: the loops of one call went round more than 1,000,000 times"),
        (
            f"kept = []\n{LATE.replace('n = 0', 'kept.append(n := 0)')}",
            r"reward\.py:[45]: car \d: the function did not return within 2 s",
        ),
    ],
)
def test_a_call_that_does_not_end_ends_the_job_which_is_not_tried_again(
    source: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(RewardFailed, match=f"^{message}$"):
        trained(source, tmp_path, nan_limit=100.0)
    assert issubclass(RewardFailed, UserError)  # exit code 2


@pytest.mark.parametrize("before", ["", "kept = []\nkept.append(1)\n"])
@pytest.mark.parametrize(
    "fault", ["1 / (params['steps'] - 7)", "1e30 * (9 + params['x']) if params['steps'] == 7 else 1.0"]
)
def test_a_function_that_fails_in_too_many_worlds_ends_the_job_which_is_not_tried_again(
    fault: str, before: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(
        UserError, match=r"its reward term reward was not finite: reward\.py.*; that is more than nan_limit"
    ):
        trained(f"{before}def reward_function(params):\n    return {fault}\n", tmp_path, nan_limit=0.0)
    output = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: reward.py")]
    assert len(output) == 1 and ("ZeroDivisionError" in output[0] or "e+30; a reward is from -100,000" in output[0])
