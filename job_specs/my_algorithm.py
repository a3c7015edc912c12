"""A custom algorithm, whole: advantage actor-critic (A2C, arXiv:1602.01783). `job_specs/my-algorithm.yaml` trains with it.

An iteration is: begin; then `steps` times act, the task's step, record; then learn. worker/learning/algorithm.py says all of it.
W is the number of worlds that this rank simulates. All is plain torch, and runs on CPU and GPU, on one rank or many.
"""

import copy
from typing import Annotated

import torch
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from tensordict import TensorDict
from torch import nn
from torch.distributions import Normal

from worker.learning.algorithm import ExportedPolicy


@dataclass(frozen=True, config=ConfigDict(extra="forbid", strict=True))
class Settings:
    """What the job may set under `settings`. Pydantic checks it: a wrong name or value ends the job with one line that says so."""

    steps: Annotated[int, Field(ge=1)] = 16  # control steps of every world in one iteration
    hidden: Annotated[int, Field(ge=1)] = 32  # width of the two hidden layers
    learning_rate: Annotated[float, Field(gt=0)] = 0.003
    gamma: Annotated[float, Field(ge=0, le=1)] = 0.98  # discount of the reward per control step

    fixed = ("hidden",)  # what a run that is resumed can't change: its checkpoints hold weights of that shape


def layers(inputs, hidden, outputs):
    """A small network: shape (n, inputs) to shape (n, outputs)."""
    middle = nn.Linear(inputs, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh()
    return nn.Sequential(*middle, nn.Linear(hidden, outputs))


class Policy(nn.Module):
    """What is learnt, evaluated and exported: a normal distribution of actions for each observation."""

    def __init__(self, settings, spaces):
        super().__init__()
        shape = spaces.observations["policy"]  # of one observation; a task may have further groups, such as "critic"
        if spaces.discrete or len(shape) > 1:
            raise ValueError("task: my algorithm takes numbers and gives numbers, no images and no choices")
        self.mean = layers(shape[0], settings.hidden, spaces.actions)
        self.log_std = nn.Parameter(torch.full((spaces.actions,), -0.5))
        self.register_buffer("square", torch.ones(shape))  # running mean of each observation's square

    def scale(self, obs):
        """Metres and radians to numbers of about 1, from which networks learn faster: shape (n, observations)."""
        return obs / (self.square.sqrt() + 1e-6)

    def forward(self, obs):
        """The best action of each observation, without noise: shape (n, actions) for (n, observations). This is what is exported."""
        return self.mean(self.scale(obs))

    @torch.no_grad()
    def act(self, observations):
        """For evaluation."""
        return self(observations["policy"])

    def reset(self, worlds=None):
        """A recurrent policy would forget here what it remembers of an episode."""

    def module(self):
        """For ONNX, on the CPU, with observations on which the file is compared with this policy before it is published."""
        network = copy.deepcopy(self).cpu()
        sample = torch.randn(64, len(self.square), generator=torch.Generator().manual_seed(0)) * network.square.sqrt()
        return ExportedPolicy(network, {"obs": sample[:1]}, ["actions"], TensorDict({"policy": sample}, [64]))


class Mine:
    """The algorithm; `algorithm: job_specs.my_algorithm:Mine` in a job names it."""

    config_type = Settings
    captures_rollout = (
        False  # True promises that act and record can become a CUDA graph (worker/learning/cuda_graph.py)
    )
    graphs = ()  # what learn replays as CUDA graphs: nothing

    def __init__(self, config, setting):
        self.config, self.gang, self.steps = config, setting.gang, config.steps
        self.part = setting.share.count / setting.share.total  # of all worlds, how many are this rank's
        self.actor = Policy(config, setting.spaces).to(self.gang.device)
        self.critic = layers(len(self.actor.square), config.hidden, 1).to(self.gang.device)
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        for parameter in self.parameters:
            self.gang.broadcast(parameter.data)  # all ranks begin with the same weights
        self.optimizer = torch.optim.Adam(self.parameters, config.learning_rate)

    def value(self, obs):
        """What the critic expects of the future: shape (n,) for observations of shape (n, observations)."""
        return self.critic(self.actor.scale(obs)).squeeze(1)

    def begin(self, iteration):
        """A new rollout. A schedule of the learning rate would have its place here."""
        self.seen, self.drawn, self.rewards, self.going_on = [], [], [], []

    @torch.no_grad()
    def act(self, observations):
        """Actions with noise, shape (W, actions). torch's generator is saved with each checkpoint: a resumed run draws the same."""
        self.seen.append(observations["policy"].clone())  # the task writes the next ones into the same memory
        mean = self.actor(self.seen[-1])
        self.drawn.append(mean + self.actor.log_std.exp() * torch.randn_like(mean))
        return self.drawn[-1]

    @torch.no_grad()
    def record(self, step):
        """What came of the actions: rewards, dones and time_outs, shape (W,)."""
        # an episode that the clock ended would have gone on: what it would have brought belongs to its last reward
        future = self.value(step.terminal_observations["policy"])
        self.rewards.append(step.rewards + self.config.gamma * torch.where(step.time_outs, future, 0.0))
        self.going_on.append((~step.dones).float())

    def learn(self, observations):
        """One step of the optimizer. Gives numbers for the log, which must be the same on all ranks."""
        returns, future = [], self.value(observations["policy"]).detach()
        for reward, going_on in zip(reversed(self.rewards), reversed(self.going_on), strict=True):
            future = reward + self.config.gamma * going_on * future
            returns.insert(0, future)
        requested, seen, drawn = torch.cat(returns), torch.cat(self.seen), torch.cat(self.drawn)  # shape (steps · W, …)
        values = self.value(seen)
        advantages = (requested - values).detach()  # how much better an action was than expected
        # each rank's mean counts as much as it has worlds: summed over the ranks it is the mean over all worlds
        size = self.gang.sum(self.part * advantages.square().mean()).sqrt() + 1e-6
        policy = Normal(self.actor(seen), self.actor.log_std.exp(), validate_args=False)
        policy_loss = -(policy.log_prob(drawn).sum(1) * advantages / size).mean()
        value_loss = (values - requested).square().mean()
        self.optimizer.zero_grad()
        (self.part * (policy_loss + 0.5 * value_loss)).backward()
        for parameter in self.parameters:
            self.gang.sum(parameter.grad)
        nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.optimizer.step()
        self.actor.square.lerp_(self.gang.sum(self.part * seen.square().mean(0)), 0.05)
        reported = self.gang.sum(self.part * torch.stack((policy_loss, value_loss)).detach())
        return {
            "policy_loss": reported[0],
            "value_loss": reported[1],
            "action_std": self.actor.log_std.detach().exp().mean(),
        }

    def policy(self):
        """What is evaluated at the end."""
        return self.actor

    def state_dict(self):
        """All that a checkpoint must hold of learning, with the policy under `policy`."""
        parts = {"policy": self.actor, "critic": self.critic, "optimizer": self.optimizer}
        return {name: part.state_dict() for name, part in parts.items()}

    def load_state_dict(self, state, *, weights_only=False, changed=()):
        """Go on from a checkpoint; gives lines for the log. `changed` are settings that this job gives otherwise."""
        self.actor.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        if not weights_only:
            self.optimizer.load_state_dict(state["optimizer"])
            self.optimizer.param_groups[0]["lr"] = self.config.learning_rate
        return []

    def world_state(self):
        """What is kept of each world from one iteration to the next, such as a replay: nothing."""
        return {}

    def load_world_state(self, state):
        """Nothing."""

    @classmethod
    def build_policy(cls, config, spaces, device):
        """For evaluation and export, which need the policy alone."""
        return Policy(config, spaces).to(device)
