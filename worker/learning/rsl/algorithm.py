"""rsl_rl's PPO, its Distillation, or a user's compatible class, as an algorithm of Muster.

rsl_rl computes as in its own runner, with the same draws from torch's generators: on one rank the weights are the same, bit for bit. Over
several ranks it averages gradients and adapts the learning rate with the KL of all; each rank normalises its own advantages. A time-out
is valued by the observation before the step. Nothing of it is captured in a graph, and it reads numbers from the device after each
minibatch.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from rsl_rl.algorithms import Distillation
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict

from worker.learning.algorithm import POLICY, LearningSetting, Policy, Spaces, Transition
from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.rsl import construction
from worker.learning.rsl.policy import RslRlPolicy
from worker.learning.rsl.vector_environment import as_floats
from worker.settings.rsl_rl import NETWORKS, RslRlConfig


class RslRl:
    """See :class:`worker.learning.algorithm.Algorithm`."""

    config_type: ClassVar[Any] = RslRlConfig
    captures_rollout: ClassVar[bool] = False

    def __init__(self, config: RslRlConfig, setting: LearningSetting) -> None:
        """Build the algorithm of ``config``. Raises ValueError, in one line with the key, for settings that rsl_rl refuses."""
        self.steps = config.num_steps_per_env
        self.teacher_checkpoint = config.teacher_checkpoint
        self.graphs: Sequence[CudaGraphFunction] = ()
        self.algorithm, groups, self._groups = construction.build_algorithm(config, setting)
        """rsl_rl's own object."""
        self._gang, self._worlds, self._ranges = setting.gang, setting.share.count, setting.action_ranges
        self._networks = {
            name: getattr(self.algorithm, f"_raw_{name}", getattr(self.algorithm, name))
            for name in NETWORKS
            if hasattr(self.algorithm, name)
        }
        self._distils = isinstance(self.algorithm, Distillation)
        self._acting = f"{'student' if self._distils else 'actor'}_state_dict"
        self._curiosity = getattr(self.algorithm, "rnd", None)
        self._configured_rate: float | None = config.algorithm.get("learning_rate")
        self._intrinsic = torch.zeros((), device=setting.gang.device)
        self._policy = RslRlPolicy(self.algorithm.get_policy(), groups, setting.spaces)
        if self._distils and setting.rehearsal:
            self.algorithm.teacher_loaded = True  # weights don't affect the memory
        if setting.gang.size > 1:
            self.algorithm.broadcast_parameters()
        self._begin_memories(construction.example_of(setting.spaces, self._worlds, setting.gang.device))
        self.algorithm.train_mode()

    # -- an iteration -------------------------------------------------------------------------------------------------

    def begin(self, iteration: int) -> None:
        """Raises ValueError if the teacher's weights were not loaded."""
        if not getattr(self.algorithm, "teacher_loaded", True):
            raise ValueError("rsl_rl.teacher_checkpoint: the teacher's weights were not loaded")
        self._intrinsic.zero_()

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """Draw actions, shape (worlds, actions), from torch's generator."""
        actions: torch.Tensor = self.algorithm.act(as_floats(observations, self._groups))
        return actions

    @torch.no_grad()
    def record(self, step: Transition) -> None:
        """Record the result of the step, in copies."""
        self.algorithm.process_env_step(
            as_floats(step.observations, self._groups),
            step.rewards.clone(),
            step.dones.long(),
            {"time_outs": step.time_outs.float()},
        )
        if self._curiosity:
            self._intrinsic += self.algorithm.intrinsic_rewards.mean()

    def learn(self, observations: TensorDict) -> Mapping[str, torch.Tensor]:
        """The metrics of rsl_rl's ``update``, as means over the ranks, ``learning_rate``, and for a stochastic policy ``action_std``.

        With a critic also ``explained_variance``, for a task with ranges of actions ``saturation``; with RND ``intrinsic_reward``, a
        mean over the steps, and ``rnd_weight``.
        """
        with torch.no_grad():
            self.algorithm.compute_returns(as_floats(observations, self._groups))
            described = self._describe_rollout()
        losses = {name: float(value) for name, value in self.algorithm.update().items()}
        number = partial(torch.tensor, device=self._gang.device, dtype=torch.float64)
        own = dict(zip(losses, number([*losses.values()]), strict=True)) | described
        if self._curiosity:
            own["intrinsic_reward"] = self._intrinsic.double() / self.steps
        if getattr(self.algorithm.get_policy(), "distribution", None) is not None:
            own["action_std"] = self.algorithm.get_policy().output_std.detach().double().mean()
        means = self._gang.sum(torch.stack([*own.values()])) / self._gang.size
        self._share_statistics()
        metrics = dict(zip(own, means, strict=True))
        if self._curiosity:
            metrics["rnd_weight"] = number(self._curiosity.weight)
        return {**metrics, "learning_rate": number(self.learning_rate)}

    def _describe_rollout(self) -> dict[str, torch.Tensor]:
        """Figures of this rank's rollout, each of shape (), float64; none without a critic."""
        storage: Any = getattr(self.algorithm, "storage", None)
        if self._distils or not all(hasattr(storage, name) for name in ("returns", "values", "actions")):
            return {}
        returns, errors = storage.returns.double(), (storage.returns - storage.values).double()
        figures = {"explained_variance": 1.0 - errors.var() / returns.var().clamp(min=1e-12)}
        ranges = dict(item for item in enumerate(self._ranges) if item[1])
        if ranges:
            actions = storage.actions[..., list(ranges)]
            within = torch.clamp(actions, *torch.tensor([*ranges.values()], device=actions.device).t())
            figures["saturation"] = (within != actions).double().mean()
        return figures

    def _share_statistics(self) -> None:
        """Give all ranks the same running statistics.

        rsl_rl's normalisers sum their moments over the ranks themselves; statistics of other layers, such as a ``BatchNorm2d``, are
        averaged.
        """
        if self._gang.size == 1:
            return
        modules = itertools.chain(*(network.modules() for network in self._networks.values()))
        for module in dict.fromkeys(modules):  # two networks may share convolutions
            if isinstance(module, EmpiricalNormalization):
                continue
            for statistic in module.buffers(recurse=False):
                if statistic.is_floating_point():
                    self._gang.sum(statistic).div_(self._gang.size)

    @property
    def learning_rate(self) -> float:
        """The present learning rate."""
        return float(self.algorithm.optimizer.param_groups[0]["lr"])

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        self.algorithm.learning_rate = value
        for group in self.algorithm.optimizer.param_groups:
            group["lr"] = value

    # -- the teacher --------------------------------------------------------------------------------------------------

    def load_teacher(self, state: Mapping[str, Any]) -> None:
        """See :class:`worker.learning.algorithm.Student`. Raises ValueError without a teacher, or if the weights do not fit it."""
        if not self._distils:
            raise ValueError("rsl_rl.teacher_checkpoint: only Distillation has a teacher")
        try:
            self.algorithm.load({"actor_state_dict": state[POLICY]}, {"teacher": True}, True)
        except (RuntimeError, KeyError) as error:
            raise ValueError(
                "rsl_rl.teacher: the weights do not fit; set teacher and obs_groups.teacher to the values of actor and obs_groups.actor in "
                f"the teacher's run: {' '.join(str(error).split())}"
            ) from error

    # -- state --------------------------------------------------------------------------------------------------------

    def policy(self) -> Policy:
        """The actor, or the student: a live view."""
        return self._policy

    def state_dict(self) -> Mapping[str, Any]:
        """The result of rsl_rl's ``save``, with the weights of the policy under ``policy``, and the position in RND's schedule."""
        saved = dict(self.algorithm.save())
        saved.pop(self._acting, None)
        curious = {"rnd_steps": self._curiosity.update_counter} if self._curiosity else {}
        return {
            POLICY: self.algorithm.get_policy().state_dict(),
            **saved,
            **curious,
            "asked_rate": self._configured_rate,
        }

    def load_state_dict(
        self, state: Mapping[str, Any], *, weights_only: bool = False, changed: Collection[str] = ()
    ) -> list[str]:
        """Continue from :meth:`state_dict`; ``weights_only``: only from its networks, with a new optimizer.

        A learning rate that this job changes overrides the saved one, which may have adapted. Raises RuntimeError, ValueError or KeyError
        if the state does not fit.
        """
        rate = self._configured_rate
        saved = {name: value for name, value in state.items() if name not in (POLICY, "rnd_steps", "asked_rate")}
        saved[self._acting] = state[POLICY]
        if weights_only:
            self.algorithm.load(saved, {name: f"{name}_state_dict" in saved for name in self._networks}, True)
            if self._curiosity and "rnd_state_dict" in saved:
                self._curiosity.load_state_dict(saved["rnd_state_dict"])
            return []
        self.algorithm.load(saved, None, True)
        _count_on_host(self.algorithm.optimizer)
        if self._curiosity:
            _count_on_host(self._curiosity.optimizer)
            self._curiosity.update_counter = int(state["rnd_steps"])
        if rate is None or rate == state["asked_rate"]:
            return []
        self.learning_rate = rate
        return [f"learning rate set to {rate:g}"]

    def _begin_memories(self, example: TensorDict) -> None:
        """Allocate rsl_rl's state of each world, zeros, now instead of in the first step.

        The teacher's is not included: rsl_rl clears it before each iteration.
        """
        self._recurrent = {
            name: network for name, network in self._networks.items() if network.is_recurrent and name != "teacher"
        }
        for network in self._recurrent.values():
            network.eval()
            with torch.no_grad():
                network(example)
            _set_hidden(network, [torch.zeros_like(part) for part in _hidden(network)])
        normalizer = getattr(self._curiosity, "reward_normalizer", None)
        self._averages = getattr(normalizer, "disc_avg", None)
        if self._averages:
            self._averages.avg = torch.zeros(self._worlds, device=self._gang.device)

    def world_state(self) -> Mapping[str, torch.Tensor]:
        """Recurrent states, shape (worlds, layers, size), and RND's discounted sums of its rewards, shape (worlds,), float32."""
        state = {
            f"{name}.{index}": part.detach().transpose(0, 1)
            for name, network in self._recurrent.items()
            for index, part in enumerate(_hidden(network))
        }
        return {**state, "rnd": self._averages.avg} if self._averages else state

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Continue from :meth:`world_state`. Raises ValueError if something is missing or has another shape."""
        expected = self.world_state()
        for name, tensor in expected.items():
            if name not in state or state[name].shape != tensor.shape:
                raise ValueError(
                    f"the saved state of rsl_rl does not fit: {name} is not of shape {tuple(tensor.shape)}"
                )
        copies = {name: state[name].to(tensor.device, copy=True) for name, tensor in expected.items()}
        for name, network in self._recurrent.items():
            parts = [copies[f"{name}.{index}"] for index, _ in enumerate(_hidden(network))]
            _set_hidden(network, [part.transpose(0, 1).contiguous() for part in parts])
        if "student" in self._recurrent:
            # an iteration learns from the student's state at its beginning
            self.algorithm.last_hidden_states = (self._recurrent["student"].get_hidden_state(), None)
        if self._averages:
            self._averages.avg = copies["rnd"]

    @classmethod
    def build_policy(cls, config: RslRlConfig, spaces: Spaces, device: str) -> Policy:
        """The actor, or the student, alone."""
        _, names = construction.algorithm_type(config)
        example = construction.example_of(spaces, 1, device)
        sets = construction.observation_sets(config, names, example)
        model = construction.build_network(config, names[0], sets, example, spaces.actions).to(device).eval()
        return RslRlPolicy(model, sets[names[0]], spaces)


def _count_on_host(optimizer: torch.optim.Optimizer) -> None:
    """Move an optimizer's step counts to the host, where it creates them: it reads them in each step, and would keep loaded ones on the
    device."""
    if any(optimizer.defaults.get(name) for name in ("fused", "capturable")):
        return
    for state in optimizer.state.values():
        if isinstance(state.get("step"), torch.Tensor):
            state["step"] = state["step"].cpu()


def _hidden(network: Any) -> tuple[torch.Tensor, ...]:
    """The recurrent state, each part of shape (layers, worlds, size): one part for a GRU, two for an LSTM."""
    state = network.get_hidden_state()
    return state if isinstance(state, tuple) else (state,)


def _set_hidden(network: Any, parts: Sequence[torch.Tensor]) -> None:
    network.reset(hidden_state=tuple(parts) if len(parts) > 1 else parts[0])
