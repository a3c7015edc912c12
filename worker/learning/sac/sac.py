"""SAC, the soft actor-critic (Haarnoja et al. 2018, arXiv:1801.01290, arXiv:1812.05905), over a gang of ranks, for thousands of worlds.

Its speed comes from the methods of FastTD3 (arXiv:2505.22642), FastSAC (arXiv:2512.01996) and FlashSAC (arXiv:2604.04539): thousands of
worlds and equally large batches, several updates per step, critics that predict a distribution and have layer normalisation, targets from
their mean instead of the least, normalised observations, AdamW with a little weight decay, a small discount, and a target entropy near 0.

- The gradients of critics, policy and temperature are taken at the same weights, of the same samples, and lie in one buffer: a gang
  has one collective per update.
- Each rank samples its share of the batch from the replay of its own worlds. Gradients, losses and the moments of observations are those
  of the whole gang, so the ranks' weights stay identical bit for bit.
- All random draws are made in :meth:`SAC.begin`; action noise depends only on (seed, iteration, step, global world index).
- A time-out is not a termination: the target bootstraps from the observation before the reset. Only a true termination has no future.
- On CUDA all updates of an iteration are one graph; in a gang of several ranks the collectives stand between smaller graphs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from types import ModuleType
from typing import Any, ClassVar

import torch
from tensordict import TensorDict

from worker.learning.algorithm import POLICY, LearningSetting, Spaces, Transition
from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.observations import gather_moments, merge_moments
from worker.learning.randomness import mix_seed
from worker.learning.sac import kernels
from worker.learning.sac.learner import LOSSES, Learner
from worker.learning.sac.networks import SquashedGaussianActor, check_spaces, size_of
from worker.learning.sac.replay_buffer import ReplayBuffer
from worker.settings.sac import SACConfig

SAVED = {"cpu": 64 << 20, "cuda": 4 << 20}
"""With ``save_replay: auto``, a rank's replay up to this size [bytes] is part of its checkpoints. A GPU's iteration takes milliseconds,
and so does a save of this size; a resumed run is not bit-identical there in any case."""


class SAC:
    """Collects with :meth:`act` and :meth:`record`, then :meth:`learn`; see :class:`worker.learning.algorithm.Algorithm`."""

    config_type: ClassVar[type[SACConfig]] = SACConfig
    captures_rollout: ClassVar[bool] = True
    kernels: ClassVar[tuple[ModuleType, ...]] = (kernels,)

    def __init__(self, config: SACConfig, setting: LearningSetting) -> None:
        """Allocate all buffers once. Raises ValueError for images, choices, an unknown group, or a batch without a sample for some rank."""
        self.gang, self.share, self.seed, spaces = setting.gang, setting.share, setting.seed, setting.spaces
        check_spaces(spaces, (POLICY, config.critic_group))
        if config.batch_size < self.gang.size:
            raise ValueError(
                f"sac.batch_size: {self.gang.size} ranks need at least as many samples, got {config.batch_size}"
            )
        self.config, self.steps, self.device = config, config.steps, self.gang.device
        self._groups = list(dict.fromkeys((POLICY, config.critic_group)))
        sizes = [size_of(spaces, group) for group in self._groups]
        self.learner = Learner(config, sizes, spaces.actions, self.gang)
        width = self.learner.width
        self.replay = ReplayBuffer(
            config.replay_steps, self.share.count, width, spaces.actions, config.n_step, config.gamma, self.device
        )
        if setting.rehearsal:
            self.replay.advance(max(config.replay_steps, config.warm_up))
        self._saves_replay = self._decide_saving(reports=self.gang.is_main and not setting.rehearsal)
        self._updates = 0
        self._learns = False
        self._allocate(width, spaces.actions)
        self._make_graphs()

    def _decide_saving(self, *, reports: bool) -> bool:
        """Whether checkpoints hold the replay; the same on all ranks. ``reports``: print the decision if the settings leave it open."""
        if self.config.save_replay != "auto":
            return self.config.save_replay
        most, ranks = SAVED[self.device.partition(":")[0]], self.gang.size
        size = self.replay.nbytes // self.share.count * -(-self.share.total // ranks)
        if size > most and reports:
            print(
                f"checkpoints do not hold the replay, {size / 2**20:,.0f} MiB a rank: a run that is resumed fills a new one first "
                "(sac.save_replay: true saves it, and takes longer to save)",
                flush=True,
            )
        return size <= most

    def _allocate(self, width: int, actions: int) -> None:
        config, device, samples = self.config, self.device, self.learner.samples
        self._step = 0
        self._source = torch.Generator(device)
        self._keys = torch.zeros(self.steps, dtype=torch.int32, device=device)
        self._uniform = torch.zeros(1, dtype=torch.int32, device=device)
        self._slots = torch.zeros(self.steps, dtype=torch.int64, device=device)
        self._before = torch.zeros(self.share.count, width + actions, device=device)
        self._actions = torch.zeros(self.share.count, actions, device=device)
        self._all_rows = torch.zeros(config.updates, samples, dtype=torch.int64, device=device)
        self._all_noise = torch.zeros(config.updates, 2, samples, actions, device=device)
        self._rows, self._noise = torch.zeros_like(self._all_rows[0]), torch.zeros_like(self._all_noise[0])
        self._moment_sums = torch.zeros(1 + 2 * width, dtype=torch.float64, device=device)
        columns = self.learner.columns
        sums = [self._moment_sums[1 + 2 * each.start : 1 + 2 * each.stop] for each in columns]
        self._moments = list(zip(self.learner.normalizers, columns, sums, strict=True))
        """For each group: its normaliser, its columns, and the sums of its moments, shape (2 · size,)."""
        self._loss_sums = torch.zeros(len(LOSSES), device=device)
        counts = {"actor_loss": config.updates // config.policy_delay, "entropy": config.updates // config.policy_delay}
        self._counts = torch.tensor([counts.get(name, config.updates) for name in LOSSES], device=device)
        self._means = torch.zeros(len(LOSSES), device=device)
        self._spread = torch.zeros((), device=device)
        self._figures = torch.zeros(2, device=device)
        self._norm = torch.zeros((), device=device)
        self._rate = torch.tensor(config.critic_learning_rate, device=device)

    def _make_graphs(self) -> None:
        """The graphs that the device replays: two in a gang of one, otherwise the parts between the collectives.

        Only graphs that are called, since the loop waits for all of them before it reports their capture.
        """
        wholes: dict[str, Callable[[], None]] = {}
        parts: dict[str, Callable[[], None]] = {}
        if self.config.normalize_observations:
            wholes = {"moments": self._observe}
            parts = {"gather moments": self._gather_moments, "merge moments": self._merge_moments}
        if self.config.policy_delay > 1:
            parts |= {"critic gradients": lambda: self._compute(False), "critic step": lambda: self._apply(False)}
        wholes |= {"updates": self._update}
        parts |= {"all gradients": lambda: self._compute(True), "all steps": lambda: self._apply(True)}
        graphs = wholes if self.gang.size == 1 else parts
        recorded = {name: CudaGraphFunction(function, self.device, name) for name, function in graphs.items()}
        self.graphs: Sequence[CudaGraphFunction] = [*recorded.values()]
        self._run: dict[str, Callable[[], None]] = {**wholes, **parts, **recorded}

    # -- collecting ---------------------------------------------------------------------------------------------------

    def begin(self, iteration: int) -> None:
        """Draw the keys of this iteration's action noise, the same on all ranks, and this rank's samples and their noise."""
        config, replay = self.config, self.replay
        self._step = 0
        self._source.manual_seed(mix_seed(self.seed, iteration, 0))
        self._keys.random_(0, 2**31 - 1, generator=self._source)
        replay.find_slots(self._slots)
        self._uniform.fill_(int(self._updates == 0 and replay.recorded < config.warm_up))
        self._source.manual_seed(mix_seed(self.seed, iteration, 1, self.gang.rank))
        enough = replay.recorded + self.steps >= config.warm_up
        self._learns = enough and replay.draw(self._all_rows, self._source, self.steps)
        if self._learns:
            torch.randn(self._all_noise.shape, generator=self._source, out=self._all_noise)

    @torch.no_grad()
    def act(self, observations: TensorDict) -> torch.Tensor:
        """Actions of the policy with its noise, or uniform ones, shape (worlds, actions), float32."""
        for group, columns in zip(self._groups, self.learner.columns, strict=True):
            self._before[:, columns].copy_(observations[group])
        actor, seen = self.learner.actor, self._before[:, self.learner.columns[0]]
        mean, log_std = actor.spread(actor.normalizer(seen))
        if self._step == 0:
            self._spread.copy_(log_std.exp().mean())
        first, limit = self.share.first, self.config.action_limit
        kernels.explore(self._keys, self._step, first, self._uniform, limit, mean, log_std, self._actions)
        return self._actions

    @torch.no_grad()
    def record(self, step: Transition) -> None:
        """Write the result of the step into the replay."""
        ended = step.dones.unsqueeze(1)
        after = [torch.where(ended, step.terminal_observations[g], step.observations[g]) for g in self._groups]
        goes_on = ~step.dones
        outcomes = torch.stack((step.rewards, goes_on.float(), (goes_on | step.time_outs).float()), 1)
        self._before[:, self.learner.width :].copy_(self._actions)
        slot = self._slots[self._step : self._step + 1]
        self.replay.write(slot, self._before, torch.cat(after, 1), outcomes)
        self._step += 1

    # -- learning -----------------------------------------------------------------------------------------------------

    def learn(self, observations: TensorDict) -> Mapping[str, torch.Tensor]:
        """All updates of the iteration; until the replay holds enough steps, only the normalisers learn.

        Args:
            observations: Unused; those after the last step were recorded with it.

        Returns:
            Means over the updates of :data:`LOSSES`, of the norm of the critics' gradients and, with several atoms, of the targets'
            probability of ``v_max``; the deviation of the actions before squashing in the first step; the temperature, and the critics'
            learning rate. Until the first update, all but the last two are 0.
        """
        self.replay.advance(self.steps)
        if self.config.normalize_observations:
            self._run["moments"]()
        if self._learns:
            self._run["updates"]()
            self._updates += self.config.updates
        figures = dict(zip(LOSSES, self._means, strict=True))
        figures |= {"action_std": self._figures[0], "gradient_norm": self._norm}
        if self.config.atoms > 1:
            figures["v_max_mass"] = self._figures[1]
        return {**figures, "temperature": self.learner.temperature, "learning_rate": self._rate}

    def _observe(self) -> None:
        """Merge the iteration's observations, of all ranks, into the normalisers."""
        self._run["gather moments"]()
        self.gang.sum(self._moment_sums)
        self._run["merge moments"]()

    @torch.no_grad()
    def _gather_moments(self) -> None:
        newest = self.replay.before[self._slots]
        self._moment_sums[0].fill_(newest.shape[0] * newest.shape[1])
        for normalizer, columns, sums in self._moments:
            gather_moments(newest[..., columns], normalizer, sums)

    @torch.no_grad()
    def _merge_moments(self) -> None:
        for normalizer, _, sums in self._moments:
            merge_moments(normalizer, self._moment_sums[0], sums)

    def _update(self) -> None:
        """All updates of an iteration."""
        learner, updates = self.learner, self.config.updates
        for sums in (self._loss_sums, learner.mass, learner.norm):
            sums.zero_()
        for number, (rows, noise) in enumerate(zip(self._all_rows, self._all_noise, strict=True), start=1):
            improves = number % self.config.policy_delay == 0
            self._rows.copy_(rows)
            self._noise.copy_(noise)
            self._run["all gradients" if improves else "critic gradients"]()
            self.gang.sum(self.learner.shared(improves))
            self._run["all steps" if improves else "critic step"]()
        torch.div(self._loss_sums, self._counts, out=self._means)
        torch.div(learner.norm, updates, out=self._norm)
        self._figures[0].copy_(self._spread * (self.share.count / self.share.total))
        self._figures[1].copy_(learner.mass / updates)
        self.gang.sum(self._figures)  # apart from the gradients: their bits must not depend on the metrics

    def _compute(self, improves: bool) -> None:
        self.learner.compute(self.replay.sample(self._rows), self._noise, improves)

    def _apply(self, improves: bool) -> None:
        self._loss_sums.add_(self.learner.losses)
        self.learner.apply(improves)

    # -- state --------------------------------------------------------------------------------------------------------

    def policy(self) -> SquashedGaussianActor:
        """The actor is the policy."""
        return self.learner.actor

    @classmethod
    def build_policy(cls, config: SACConfig, spaces: Spaces, device: str) -> SquashedGaussianActor:
        """A policy that can load the ``policy`` of a :meth:`state_dict`."""
        check_spaces(spaces, (POLICY,))
        return SquashedGaussianActor(config, size_of(spaces, POLICY), spaces.actions).to(device)

    def state_dict(self) -> Mapping[str, Any]:
        """Networks, normalisers, temperature, optimizers, and the number of updates."""
        return {**self.learner.state_dict(), "updates": self._updates}

    def load_state_dict(
        self, state: Mapping[str, Any], *, weights_only: bool = False, changed: Collection[str] = ()
    ) -> list[str]:
        """Continue from :meth:`state_dict`. The replay, which is part of :meth:`world_state`, stays unchanged.

        Rates and decays are always this job's, whatever the checkpoint's were.
        """
        self._updates = int(state["updates"])
        self.learner.load_state_dict(state, weights_only=weights_only)
        for graph in self.graphs:
            graph.release()
        self._make_graphs()  # the old graphs would continue with the optimizers' old moments
        rates = [name for name in changed if name.endswith("_rate")]
        return [f"{name} set to {getattr(self.config, name):g}" for name in rates]

    def world_state(self) -> Mapping[str, torch.Tensor]:
        """The replay, if checkpoints hold it."""
        return self.replay.world_state() if self._saves_replay else {}

    def load_world_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Continue with the replay of :meth:`world_state`, or with an empty one if none was saved."""
        if state:
            self.replay.load_world_state(state)
        else:
            self.replay.advance(-self.replay.recorded)
